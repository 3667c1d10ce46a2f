"""Passes of `patch`: targets, units to code again, index."""
