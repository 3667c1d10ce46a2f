"""GDAL's XML of datasets: rasters that are warped when they are read, and what only XML says."""
