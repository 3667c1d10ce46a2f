"""Pictures of compressed terrain: a window to fly in, and the same pictures without one.

`scene` has what is seen from where, `modes` the ways to draw a terrain, `paging` what comes and
goes as a camera moves, `look` colours and what lies over pictures: all of these are numbers alone.
`gpu` draws, `window` is the window and what commands ask for.
"""

# Of memory on the GPU, where nothing else is asked for.
DEFAULT_MAX_BYTES = 1 << 30
