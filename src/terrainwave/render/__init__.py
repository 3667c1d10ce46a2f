"""Pictures of compressed terrain: a window to fly in, and the same pictures without a screen.

`camera`, `frustum`, `selection`, `patches`, `paging` and `scene` need no GPU; moderngl is imported
by `renderer`, `mesh_buffers`, `offscreen` and `viewer` only.
"""

# Of memory on the GPU, where nothing else is asked for.
DEFAULT_MAX_BYTES = 1 << 30
