"""The passes of `compress` over a raster: its windows, its units coded, the proof."""
