"""Method with embedded streams: the reversible 5/3 wavelet in tiles of several levels."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from terrainwave.codec.method_options import MethodOptions
from terrainwave.errors import InvalidArgumentError
from terrainwave.option_sets import number, option

# Options of `compress` that a stream cannot have that is cut, with what is expected instead.
_BESIDE_GOALS = {
    "max_error": "one of them: a stream is cut in one place",
    "strict": "`max_error`: there is no other bound to keep strictly",
    "height_range": "one of them: streams that are cut cannot be patched",
}


@dataclass(frozen=True, kw_only=True)
class Cdf53(MethodOptions):
    """Options of method cdf53, whose files can be cut to a size or a mean error.

    Parameters
    ----------
    rate : float, optional
        Size of the file in bits per sample, > 0, instead of `max_error`. The measured error is then
        the file's bound.
    psnr : float, optional
        Required quality, > 0, in decibels of the heights' range over the root mean square error,
        instead of `max_error`.
    """

    name = "cdf53"

    rate: float | None = option(
        number(above=0), "Bits per sample that the file may take, instead of --max-error."
    )
    psnr: float | None = option(
        number(above=0),
        "Decibels of the heights' range over the root mean square error that the file must reach,"
        " instead of --max-error.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rate is not None and self.psnr is not None:
            raise InvalidArgumentError(
                f"found `rate`={self.rate:g} and `psnr`={self.psnr:g}, expected one of them: a"
                " stream is cut in one place"
            )

    @property
    def goal(self) -> str:
        """Return the option that cuts streams instead of a bound, or an empty string."""
        return "rate" if self.rate is not None else "psnr" if self.psnr is not None else ""

    def check_beside(self, given: Mapping[str, Any]) -> None:
        """Raise `InvalidArgumentError` for options of `compress` that do not go with these."""
        for name, expected in _BESIDE_GOALS.items():
            if self.goal and name in given:
                raise InvalidArgumentError(f"found `{name}` and `{self.goal}`, expected {expected}")
        super().check_beside(given)
