"""Each block from its zero trees alone (Yusov & Turlapov 2010, §2.4)."""

from terrainwave.render.modes.adaptive import Adaptive


class Loose(Adaptive):
    """`Adaptive` with non-guaranteed meshes above the finest level.

    What such a mesh is worth is measured when it is built. A block whose mesh turns out too far off
    is split then, so that pictures keep to τ here as well.
    """

    name = "loose"
    is_loose = True
