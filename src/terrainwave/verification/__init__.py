"""Comparison of files with their originals; knows nothing of what made them."""
