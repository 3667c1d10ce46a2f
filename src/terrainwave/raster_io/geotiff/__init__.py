"""GeoTIFFs as they are written, and what lies beside them."""
