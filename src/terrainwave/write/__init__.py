"""Encoding and changing of files: from raster to payloads, meshes and index."""
