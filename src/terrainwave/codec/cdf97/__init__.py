"""Method of Yusov & Turlapov 2010: the 9/7 wavelet, zero trees, residuals."""

from dataclasses import dataclass

from terrainwave.codec.method_options import BlockMethodOptions
from terrainwave.option_sets import FLAG, option


@dataclass(frozen=True, kw_only=True)
class Cdf97(BlockMethodOptions):
    """Options of method cdf97, the wavelet codec of Yusov & Turlapov 2010.

    Parameters
    ----------
    border_rings : int
        1, or 3 to share one more ring on both sides of every block border (Yusov & Turlapov 2010,
        §2.3).
    faithful : bool
        Follow Yusov & Turlapov 2010 as closely as the format can: coefficients with one wavelet
        step on all levels, and the quantiser of coarse levels and the errors of blocks as printed.
        Files become larger. Their zero trees show where the terrain is rough.
    """

    name = "cdf97"

    faithful: bool = option(
        FLAG,
        "Follow Yusov & Turlapov (2010) as closely as the format can. Files become larger.",
        default=False,
    )

    @property
    def is_faithful(self) -> bool:
        """Return whether files are to follow the paper, which other methods cannot do."""
        return self.faithful

    @property
    def without_efforts(self) -> str:
        """Return why all efforts give the same file; "" if they do not."""
        return "faithful files have one wavelet step" if self.faithful else ""
