"""Passes of `compress` over a raster: windows, coding, proof."""
