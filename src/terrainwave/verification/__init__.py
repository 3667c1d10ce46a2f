"""Comparison of files with their originals, independent of the encoder."""
