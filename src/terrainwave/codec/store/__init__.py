"""Method without compression: heights packed into bits."""

from dataclasses import dataclass

from terrainwave.codec.method_options import BlockMethodOptions


@dataclass(frozen=True, kw_only=True)
class Store(BlockMethodOptions):
    """Options of method store, which packs heights without compression.

    Parameters
    ----------
    border_rings : int
        1, or 3 to share one more ring on both sides of every block border (Yusov & Turlapov 2010,
        §2.3).
    """

    name = "store"
