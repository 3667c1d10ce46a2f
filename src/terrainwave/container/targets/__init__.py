"""Output files: temporary next to their names until complete, or uploaded to a URL."""
