"""The smallest method: every sample predicted, mixed models, a range coder."""
