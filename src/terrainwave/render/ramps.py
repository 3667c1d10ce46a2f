"""Colours by height."""

import numpy as np
from numpy.typing import NDArray

# (share of the range, red, green, blue)
_TINTS = [
    (0.00, 84, 118, 78), (0.12, 112, 140, 86), (0.28, 158, 166, 108), (0.45, 190, 176, 130),
    (0.60, 172, 146, 114), (0.73, 150, 132, 120), (0.84, 196, 194, 194), (0.93, 238, 240, 243),
    (1.00, 252, 253, 255),
]  # fmt: skip
_SEA = [
    (0.00, 12, 36, 74), (0.45, 30, 76, 128), (0.80, 66, 128, 172), (1.00, 140, 190, 208),
]  # fmt: skip
# Seven of matplotlib's cividis: read alike with and without red-green blindness.
_CIVIDIS = [
    (0.00, 0, 34, 78), (0.17, 42, 63, 108), (0.33, 88, 92, 110), (0.50, 124, 123, 120),
    (0.67, 162, 154, 116), (0.83, 205, 191, 98), (1.00, 254, 232, 56),
]  # fmt: skip
_MOON = [(0.0, 96, 94, 92), (0.5, 150, 147, 143), (1.0, 206, 203, 198)]
_MARS = [
    (0.0, 72, 42, 34), (0.35, 128, 70, 46), (0.65, 178, 108, 66), (0.9, 214, 158, 110),
    (1.0, 240, 214, 186),
]  # fmt: skip

RAMPS = {"tints": _TINTS, "cividis": _CIVIDIS, "grey": _MOON, "mars": _MARS}
N_COLORS = 512
# Metres below 0 at which the sea's colours end, so that stops ascend.
_SHORE = 0.1


def ramp_colors(name: str, low: float, high: float) -> NDArray[np.uint8]:
    """Return `N_COLORS` colours from the lowest to the highest height, in metres; uint8 (n, 3).

    ``tints`` has the sea below 0 where a raster reaches well below it.
    """
    heights = np.linspace(low, high, N_COLORS)
    if _has_sea(name, low, high):
        land = _mixed(_TINTS, heights / high)
        sea = _mixed(_SEA, 1 - heights / low)
        return np.where((heights < 0)[:, None], sea, land).astype(np.uint8)
    span = high - low or 1.0
    return _mixed(RAMPS[name], (heights - low) / span).astype(np.uint8)


def ramp_stops(name: str, low: float, high: float) -> list[tuple[float, str]]:
    """Return (height in metres, colour as #rrggbb) between which `ramp_colors` is linear."""
    if _has_sea(name, low, high):
        sea = [(low * (1 - share), rgb) for share, *rgb in _SEA[:-1]]
        stops = [*sea, (-_SHORE, _SEA[-1][1:])]
        stops += [(high * share, rgb) for share, *rgb in _TINTS]
    else:
        span = high - low or 1.0
        stops = [(low + span * share, rgb) for share, *rgb in RAMPS[name]]
    return [(height, "#" + bytes(rgb).hex()) for height, rgb in stops]


def _has_sea(name: str, low: float, high: float) -> bool:
    return name == "tints" and low < -300 and high > 300


def _mixed(stops: list[tuple[float, int, int, int]], shares: NDArray[np.float64]) -> NDArray:
    table = np.array(stops, dtype=np.float64)
    return np.column_stack([np.interp(shares, table[:, 0], table[:, k]) for k in (1, 2, 3)])
