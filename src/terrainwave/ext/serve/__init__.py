"""`terrainwave serve`: tiles, height queries and a page that flies over open .twz files.

`globe` places a terrain on the globe, `tiling` cuts terrain-RGB tiles, `app` answers
requests. Needs the extra ``serve``.
"""
