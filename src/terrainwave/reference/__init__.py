"""A slow, plain decoder of .twz files, written from FORMAT.md and its annexes alone.

Python on lists of integers; NumPy only for the arrays that come out. It shares nothing with the
rest of terrainwave but the annexes, and no other module imports it: where the two disagree, one of
them or the document is wrong. It decodes heights and validity of methods rapid, cdf97 and store.
Sections of docs/FORMAT.md are cited as §n, those of format-rapid.md as R.n. Use it to check, to
learn, or as a pattern for a decoder in another language; `terrainwave.open` is a thousand times as
fast.

    python -m terrainwave.reference FILE.twz OUT.npy
"""
