"""Byte layout of a .twz file: header, index pages, segments (docs/FORMAT.md). Knows no heights."""
