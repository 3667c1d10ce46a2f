"""Meshes of the blocks of a file, their stored parts, one mesh over any area."""
