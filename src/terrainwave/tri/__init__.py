"""Triangulations of blocks: crack-free, with a guaranteed vertical error."""
