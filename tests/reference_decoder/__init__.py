"""A slow, obvious decoder of .twz files, written from docs/FORMAT.md and its annexes alone.

Plain Python on lists of integers; numpy only for the arrays that come out. Nothing of it is
shared with `terrainwave` but the annexes, which both load, and `src` never imports it: where the
two disagree, one of them or the document is wrong. Sections of docs/FORMAT.md are cited
as §n, those of its annexes by their letters.
"""
