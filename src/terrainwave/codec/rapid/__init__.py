"""The default method: rows on a wavefront, rANS (docs/format-rapid.md)."""

from dataclasses import dataclass

from terrainwave.codec.method_options import BlockMethodOptions


@dataclass(frozen=True, kw_only=True)
class Rapid(BlockMethodOptions):
    """Options of method rapid, the default.

    Parameters
    ----------
    border_rings : int
        1, or 3 to share one more ring on both sides of every block border (Yusov & Turlapov 2010,
        §2.3).
    """

    name = "rapid"
