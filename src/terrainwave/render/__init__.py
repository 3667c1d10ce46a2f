"""Pictures of compressed terrain, in a window or without one.

`scene` has cameras and geometry, `modes` the ways to draw a terrain, `paging` the loading and
dropping of pieces, `look` colours and overlays: these work only with numbers. `gpu` draws; `window`
has the window and the commands' pictures.
"""

# Default limit of memory on the GPU.
DEFAULT_MAX_BYTES = 1 << 30
