"""`terrainwave serve`: tiles, height queries and a page that flies over open .twz files.

`globe.terrain_rgb` and `globe.cesium` cut the tiles, `app` answers requests. Needs the extra
``serve``.
"""
