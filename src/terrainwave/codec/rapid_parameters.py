"""Tables of a file of method `rapid`, and their bytes (format-rapid.md, R.10)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec import rapid_tables
from terrainwave.codec.lattice import HH, HL, LH
from terrainwave.codec.rapid_code import ESCAPE, N_SYMBOLS
from terrainwave.codec.rapid_layout import CORES, MAX_TAPS, TAPS
from terrainwave.codec.rapid_magnitude import N_CONTEXTS
from terrainwave.coding.rans import N_SLOTS, slots_of

N_CLASSES = 4  # levels: the finest, the next two, all coarser ones
PLANES = (HH, HL, LH)
WHOLE = 4096


class Tables:
    """What a file is coded with.

    Attributes
    ----------
    k_max : int
        The level of the full grid.
    stencils : ndarray of int64, shape (N_CLASSES, 3, MAX_TAPS)
    features : ndarray of int64, shape (N_CLASSES, 4, N_FEATURES)
        Weights in 2**-24 per step: of the planes, then of lines.
    """

    def __init__(
        self,
        k_max: int,
        stencils: NDArray[np.int64],
        features: NDArray[np.int64],
        freqs: NDArray[np.int64] | None,
    ) -> None:
        self.k_max = k_max
        self.stencils = stencils
        self.features = features
        self._freqs = freqs
        self._built: dict[int, tuple[NDArray[np.uint32], NDArray[np.uint32]]] = {}

    def freqs(self, step: int) -> NDArray[np.int64]:
        """Return the frequencies of symbols, shape (N_CONTEXTS, N_SYMBOLS)."""
        return rapid_tables.default_freqs(step) if self._freqs is None else self._freqs

    def slots(self, step: int) -> NDArray[np.uint32]:
        """Return the decoder's table."""
        return self._build(step)[0]

    def packed_freqs(self, step: int) -> NDArray[np.uint32]:
        """Return the encoder's table."""
        return self._build(step)[1]

    def _build(self, step: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        family = rapid_tables.family_of(step)
        if family not in self._built:
            freqs = self.freqs(step)
            before = np.cumsum(freqs, 1) - freqs
            self._built[family] = slots_of(freqs), (before << 16 | freqs).astype(np.uint32)
        return self._built[family]


FileTables = Tables
def parse_parameters(section):
    st = np.zeros((4, 3, 23), np.int64)
    for p in range(3):
        for c in range(4):
            w = rapid_tables.STENCILS[p + 1][0]
            st[c, p, : len(w)] = w
    return Tables(0, st, rapid_tables.FEATURES[0], None)
def pack_parameters(t): return b""
