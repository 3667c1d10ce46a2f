"""Stencils that a file brings along, as changes of trained ones (FORMAT.md: P.10, R.10)."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import CorruptStreamError

WHOLE = 4096
MAX_WEIGHT = (1 << 15) - 1


class FileStencil(NamedTuple):
    """A stencil as a file stores it: trained set `base`, plus ``deltas * 2**shift`` if there are.

    The weight of one tap follows from the others, whose sum with it is 4096; its delta is 0.
    """

    base: int
    shift: int = 0
    deltas: tuple[int, ...] = ()

    def weights(self, sets: NDArray[Any], missing: int, plane: int) -> NDArray[np.int64]:
        """Return the weights of a plane, whose trained `sets` and `missing` tap these are.

        Raises
        ------
        CorruptStreamError
            If the set does not exist or a weight is out of range.
        """
        if self.base >= len(sets):
            raise CorruptStreamError(f"a stencil builds on set {self.base}, which does not exist")
        weights: NDArray[np.int64] = sets[self.base].astype(np.int64)
        if self.deltas:
            weights += np.array(self.deltas, dtype=np.int64) << self.shift
            weights[missing] = 0
            weights[missing] = WHOLE - weights.sum()
            if np.abs(weights).max() > MAX_WEIGHT:
                raise CorruptStreamError(f"a stencil of plane {plane} has a weight beyond 2^15")
        return weights
