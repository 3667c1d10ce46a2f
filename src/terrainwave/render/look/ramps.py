"""Colours by height: relative, by the range, or absolute, by metres on the Earth."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.render.look.colorings import AUTO

# (share of the range, red, green, blue)
_TINTS = [
    (0.00, 84, 118, 78), (0.12, 112, 140, 86), (0.28, 158, 166, 108), (0.45, 190, 176, 130),
    (0.60, 172, 146, 114), (0.73, 150, 132, 120), (0.84, 196, 194, 194), (0.93, 238, 240, 243),
    (1.00, 252, 253, 255),
]  # fmt: skip
_SEA = [
    (0.00, 12, 36, 74), (0.45, 30, 76, 128), (0.80, 66, 128, 172), (1.00, 140, 190, 208),
]  # fmt: skip
# Seven colours of matplotlib's cividis, readable with and without red-green blindness.
_CIVIDIS = [
    (0.00, 0, 34, 78), (0.17, 42, 63, 108), (0.33, 88, 92, 110), (0.50, 124, 123, 120),
    (0.67, 162, 154, 116), (0.83, 205, 191, 98), (1.00, 254, 232, 56),
]  # fmt: skip
_MOON = [(0.0, 96, 94, 92), (0.5, 150, 147, 143), (1.0, 206, 203, 198)]
_MARS = [
    (0.0, 72, 42, 34), (0.35, 128, 70, 46), (0.65, 178, 108, 66), (0.9, 214, 158, 110),
    (1.0, 240, 214, 186),
]  # fmt: skip

# (metres, red, green, blue): land and sea of the Earth. The lowest dry land lies at -440 m.
_LAND = [
    (-440, 62, 98, 68), (0, 96, 132, 84), (150, 110, 142, 88), (400, 136, 156, 96),
    (800, 164, 170, 110), (1400, 188, 176, 128), (2200, 176, 152, 118), (3200, 156, 134, 116),
    (4500, 152, 142, 136), (6000, 178, 172, 168), (9000, 214, 212, 210),
]  # fmt: skip
_DEEP = [
    (0, 136, 186, 206), (100, 110, 166, 198), (500, 86, 146, 186), (2000, 58, 114, 162),
    (4000, 36, 84, 136), (6500, 20, 54, 102), (11000, 10, 30, 66),
]  # fmt: skip
_SNOW = np.array([246.0, 249.0, 252.0])
# Latitude, metres above which snow lies all year: rounded, as it varies by a kilometre and more
# with the climate. Southern latitudes are negative.
_SNOW_LINE = [
    (-90, -500), (-66, -500), (-60, 200), (-55, 700), (-50, 1200), (-45, 1700), (-40, 2600),
    (-35, 4000), (-30, 5200), (-20, 5800), (-10, 5200), (0, 4900), (10, 5000), (20, 5400),
    (30, 5300), (35, 4600), (40, 3800), (46, 2900), (50, 2400), (55, 1900), (60, 1500), (65, 1100),
    (70, 750), (75, 450), (80, 250), (90, 0),
]  # fmt: skip
_SNOW_BELOW, _SNOW_ABOVE = 150.0, 450.0
N_LATITUDES = 32
# Degrees
_SLOPE = [
    (0, 244, 243, 236), (10, 214, 222, 172), (20, 240, 214, 122), (30, 232, 150, 82),
    (45, 184, 70, 70), (60, 92, 30, 82),
]  # fmt: skip
_LEAST_ERROR, _MOST_ERROR = (41, 94, 153), (237, 199, 64)

RAMPS = {"tints": _TINTS, "cividis": _CIVIDIS, "grey": _MOON, "mars": _MARS}
N_COLORS = 512
# Metres below 0 at which the sea's colours end, so that stops ascend.
_SHORE = 0.1
# Least range of land's colours, in metres above the sea, for a raster below it.
_LEAST_LAND = 1.0
# Metres. The lowest shore, the Dead Sea's, is at -440 (2025) and sinks by one metre each year.
DEEPEST_LAND = -450.0


def sea_of(low: float) -> float | None:
    """Return the height of the sea in a raster of the Earth whose lowest height is `low`, metres.

    None if no height is below all dry land: then ground below 0 may be land.
    """
    return 0.0 if low < DEEPEST_LAND else None


def ramp_colors(
    name: str, low: float, high: float, sea: float | str | None = AUTO
) -> NDArray[np.uint8]:
    """Return `N_COLORS` colours from the lowest to the highest height, in metres; uint8 (n, 3).

    ``tints`` has the sea below `sea`, if that is a height; ``auto`` means `sea_of`.
    """
    heights = np.linspace(low, high, N_COLORS)
    sea = _sea_in(name, low, sea)
    if sea is not None:
        land = _mixed(_TINTS, (heights - sea) / max(high - sea, _LEAST_LAND))
        water = _mixed(_SEA, 1 - (heights - sea) / (low - sea))
        return np.where((heights < sea)[:, None], water, land).astype(np.uint8)
    span = high - low or 1.0
    return _mixed(RAMPS[name], (heights - low) / span).astype(np.uint8)


def ramp_stops(
    name: str, low: float, high: float, sea: float | str | None = AUTO
) -> list[tuple[float, str]]:
    """Return (height in metres, colour as #rrggbb) between which `ramp_colors` is linear."""
    sea = _sea_in(name, low, sea)
    if sea is not None:
        stops = [(sea + (low - sea) * (1 - share), rgb) for share, *rgb in _SEA]
        stops[-1] = (sea - min(_SHORE, (sea - low) / 100), stops[-1][1])
        span = max(high - sea, _LEAST_LAND)
        stops += [(sea + span * share, rgb) for share, *rgb in _TINTS]
    else:
        span = high - low or 1.0
        stops = [(low + span * share, rgb) for share, *rgb in RAMPS[name]]
    return [(height, "#" + bytes(rgb).hex()) for height, rgb in stops]


def _sea_in(name: str, low: float, sea: float | str | None) -> float | None:
    """Return the height of the sea in a ramp; None if it shows none."""
    level = sea_of(low) if sea == AUTO else sea
    return float(level) if name == "tints" and level is not None and low < float(level) else None


def _mixed(stops: Sequence[tuple[float, int, int, int]], shares: NDArray[np.float64]) -> NDArray:
    table = np.array(stops, dtype=np.float64)
    return np.column_stack([np.interp(shares, table[:, 0], table[:, k]) for k in (1, 2, 3)])


class Palette(NamedTuple):
    """Colours of values, for the GPU."""

    # shape (n, 2 * N_COLORS, 3); rows from the south to the north; columns: the sea's, then the
    # land's or all
    colors: NDArray[np.uint8]
    # values of the sea's first colour, of its last, of the land's first and of its last
    ranges: tuple[float, float, float, float]
    water_from: float = -math.inf  # the lowest value that a legend shows in the sea's colours

    def color_of(self, values: NDArray[np.float64], row: int) -> NDArray[np.uint8]:
        """Return the colours of values at a row's latitude, shape (n, 3)."""
        low, sea, land, high = self.ranges
        below = np.clip((values - low) / max(sea - low, 1e-9), 0, 1)
        above = np.clip((values - land) / max(high - land, 1e-9), 0, 1)
        is_water = (values <= sea) & (values >= self.water_from)
        place = np.where(is_water, below, above) * (N_COLORS - 1)
        column = np.round(place).astype(np.int64) + N_COLORS * ~is_water
        found: NDArray[np.uint8] = self.colors[row, column]
        return found


# Cached, as the viewer requests one in every frame.
@lru_cache(maxsize=8)
def relative_palette(name: str, low: float, high: float) -> Palette:
    colors = _mixed(RAMPS[name], np.linspace(0, 1, N_COLORS))
    return _one_sided(colors, low, high)


@lru_cache(maxsize=8)
def absolute_palette(
    low: float,
    high: float,
    sea: float,
    latitudes: tuple[float, float] | None,
    water_from: float = -math.inf,
) -> Palette:
    """Return the Earth's colours by metres: water up to `sea`, snow above the snow line.

    Land has colours down to the lowest dry land, as some may lie below the sea.
    """
    low, high = min(low, sea - 1.0), max(high, sea + 1.0)
    first = min(max(low, DEEPEST_LAND), sea)
    depths = np.linspace(max(sea - low, 0.0), 0.0, N_COLORS)
    heights = np.linspace(first, high, N_COLORS)
    water, land = _mixed(_DEEP, depths), _mixed(_LAND, heights)
    rows = []
    for share in np.linspace(0, 1, N_LATITUDES):
        snow = np.zeros(N_COLORS)
        if latitudes is not None:
            line = snow_line(latitudes[0] * (1 - share) + latitudes[1] * share)
            snow = np.clip((heights - line + _SNOW_BELOW) / (_SNOW_BELOW + _SNOW_ABOVE), 0, 1)
        rows.append(np.concatenate([water, land + (_SNOW - land) * snow[:, None]]))
    return Palette(np.array(rows).astype(np.uint8), (low, sea, first, high), water_from)


def snow_line(latitude: float) -> float:
    """Return the approximate height in metres above which snow lies all year."""
    degrees, metres = np.array(_SNOW_LINE, dtype=np.float64).T
    return float(np.interp(latitude, degrees, metres))


@lru_cache(maxsize=1)
def slope_palette() -> Palette:
    return _one_sided(_mixed(_SLOPE, np.linspace(0, 60, N_COLORS)), 0.0, 60.0)


def error_palette(largest: float) -> Palette:
    """Return the colours of errors, metres, by their square root, as most are small."""
    share = np.sqrt(np.linspace(0, 1, N_COLORS))[:, None]
    colors = np.array(_LEAST_ERROR) * (1 - share) + np.array(_MOST_ERROR) * share
    return _one_sided(colors, 0.0, largest)


def _one_sided(colors: NDArray[np.float64], low: float, high: float) -> Palette:
    both = np.concatenate([colors[:1].repeat(N_COLORS, axis=0), colors])[None].astype(np.uint8)
    return Palette(both, (low - 2.0, low - 1.0, low, high if high > low else low + 1.0))
