"""Rasters in and out: windows of heights with their validity, and what must come back with them.

`RasterSource` reads one band of anything rasterio opens (or an array) window by window;
`RasterSink` writes a GeoTIFF or COG the same way and renames it into place at the end. Neither
ever holds the raster: GDAL's block cache, whose default is 5 % of the machine's memory, is held at
`GDAL_CACHE_BYTES` while they work.

Which samples are valid is decided here and nowhere else in the encoder: a sample is void if it
equals nodata, is NaN, or is masked by the dataset (mask band, alpha). Both can apply at once.

Import from the submodules: `info` needs no rasterio, which costs time at start.
"""
