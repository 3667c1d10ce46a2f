"""Writing of GeoTIFFs and of files next to them."""
