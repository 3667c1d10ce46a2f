"""Method with the smallest files: every sample predicted, mixed models, a range coder."""

from dataclasses import dataclass

from terrainwave.codec.method_options import BlockMethodOptions


@dataclass(frozen=True, kw_only=True)
class Predictive(BlockMethodOptions):
    """Options of method predictive, whose files are smaller and are read more slowly.

    Parameters
    ----------
    border_rings : int
        1, or 3 to share one more ring on both sides of every block border (Yusov & Turlapov 2010,
        §2.3).
    """

    name = "predictive"
