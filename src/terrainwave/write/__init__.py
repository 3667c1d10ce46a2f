"""Making and changing files: from raster to payloads, meshes and index."""
