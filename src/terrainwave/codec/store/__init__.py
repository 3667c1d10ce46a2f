"""The smallest method: heights as they are, packed into bits."""
