"""Restricted quadtrees: as files store them, and as they follow a camera."""
