"""Input and output of rasters: windows of heights with validity, and metadata.

`RasterSource` reads one band of anything rasterio opens (or an array) window by window;
`RasterSink` writes a GeoTIFF or COG the same way and renames it into place at the end. Neither
holds the whole raster: meanwhile GDAL's block cache, by default 5 % of the machine's memory, is
limited to `GDAL_CACHE_BYTES`.

Only this package decides which samples are valid: a sample is void if it equals nodata, is NaN, or
is masked by the dataset (mask band, alpha). Several of these can apply at once.

Import from the submodules: `info` needs no rasterio, which is slow to import.
"""
