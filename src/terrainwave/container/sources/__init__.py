"""Byte sources: ranges of a file, of memory, of a URL, of a file in an archive."""
