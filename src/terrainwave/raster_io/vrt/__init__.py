"""GDAL's XML of datasets: warped rasters, and facts that only the XML states."""
