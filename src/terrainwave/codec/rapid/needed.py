"""Rows of a lattice that are wanted, and all that must be decoded for them."""

from functools import lru_cache
from typing import NamedTuple

from terrainwave.codec.rapid.details import n_strips
from terrainwave.codec.rapid.layout import HH, HL, LH, STRIP_ROWS, A, plane_shape
from terrainwave.codec.refiner import Rows

_Range = tuple[int, int]


class Needed(NamedTuple):
    """Strips and rows that some rows of a lattice need.

    Attributes
    ----------
    strips : tuple of (int, int)
        Of each band from its first strip on, since they are read in turn; none of other bands.
    features, parent : (int, int)
        Rows of A whose ranges and bends are needed, and whose heights are.
    planes : tuple of (int, int)
        Rows of HH, HL and LH, and those of the lattice that are wanted.
    """

    strips: tuple[_Range, ...]
    features: _Range
    parent: _Range
    planes: tuple[_Range, ...]


def band_strips(n_rows: int, n_bands: int) -> tuple[_Range, ...]:
    """Return the strips of each band of a lattice."""
    n = n_strips(n_rows)
    return tuple((band * n // n_bands, (band + 1) * n // n_bands) for band in range(n_bands))


@lru_cache(maxsize=256)
def needed_for(shape: tuple[int, int], rows: Rows, n_bands: int) -> Needed:
    """Return what rows of a lattice need, by what each plane is predicted from (`layout.TAPS`)."""
    n_rows, n_a = shape[0], plane_shape(A, shape)[0]
    bands = band_strips(n_rows, n_bands)
    wanted = max(rows.first, 0), min(rows.end, n_rows)
    is_all = wanted == (0, n_rows)
    first, last = wanted[0] // 2, (wanted[1] - 1) // 2
    # A row of LH needs HL one further down, HL needs HH from two rows above to one below.
    planes = []
    for plane, above, below in ((HH, 2, 2), (HL, 0, 1), (LH, 0, 0)):
        n_own = plane_shape(plane, shape)[0]
        planes.append((0 if is_all else max(first - above, 0), min(last + below + 1, n_own)))
    planes.append(wanted)
    if is_all:
        return Needed(bands, (-1, n_a + 1), (0, n_a), tuple(planes))
    begin, end = max(first - 2, 0) // STRIP_ROWS, (last + 2) // STRIP_ROWS + 1
    needed = [own if own[0] < end and own[1] > begin else (0, 0) for own in bands]
    strips = tuple((own[0], min(own[1], end)) for own in needed)
    begin = min(own[0] for own in strips if own[0] < own[1])
    # LH of a strip begins a row further up; bends take one row more on either side.
    features = max(STRIP_ROWS * begin - 1, -1), min(STRIP_ROWS * end + 1, n_a + 1)
    parent = max(features[0] - 1, 0), min(features[1] + 1, n_a)
    return Needed(strips, features, parent, tuple(planes))
