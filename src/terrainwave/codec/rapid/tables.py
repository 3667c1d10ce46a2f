"""Tables of a file: stencils, weights of what is expected, frequencies of symbols."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.rapid.layout import N_LEVEL_CLASSES
from terrainwave.codec.rapid.symbols import STEP_BITS, Frequencies

# Weights of the range and the bend, and their shift, are such that they are below this.
_MOST_WEIGHT = 1 << 13
_MOST_NEAR_WEIGHT, _MOST_SHIFT = (1 << 15) - 1, 16
# Of a step: a file's weights are whole numbers of these.
WEIGHT_UNIT_BITS = 16


class Tables(NamedTuple):
    """Tables that code a file's units.

    Attributes
    ----------
    k_max : int
        Level of the full grid: class 0.
    stencils : ndarray of int64, shape (4, 3, 24)
        By class of level and plane: weights of `layout.TAPS` in 1/4096, whose sum is 4096.
    weights : ndarray of int64, shape (4, 3, 4)
        By class and plane: a constant, and of the range, the bend and what is near, how much a step
        of it adds to the expected magnitude, in 2**-16 steps.
    frequencies : Frequencies
        Of symbols.
    """

    k_max: int
    stencils: NDArray[np.int64]
    weights: NDArray[np.int64]
    frequencies: Frequencies

    def level_class(self, level: int) -> int:
        """Return the class of a level."""
        return min(max(self.k_max - level, 0), N_LEVEL_CLASSES - 1)


def weights_of(weights: NDArray[np.int64], step: int, shift: int) -> NDArray[np.int32]:
    """Return weights (v0, v1, v2, v3, shift) of planes, for features of heights shifted by `shift`.

    A step of heights has ``step >> shift`` of these features' units.
    """
    return _made_of(weights.tobytes(), step, shift)


@lru_cache(maxsize=64)
def _made_of(weights_of_planes: bytes, step: int, shift: int) -> NDArray[np.int32]:
    weights = np.frombuffer(weights_of_planes, dtype=np.int64).reshape(-1, 4)
    made = np.zeros((len(weights), 5), dtype=np.int32)
    to_steps = WEIGHT_UNIT_BITS - STEP_BITS
    for row, (constant, of_range, of_bend, of_near) in enumerate(weights.tolist()):
        # The most by which neither weight is too large.
        most = ((_MOST_WEIGHT << to_steps) * step - 1) // max(of_range, of_bend, 1)
        more = min(max(most.bit_length() - 1 - shift, 0), _MOST_SHIFT)
        made[row] = (
            (constant >> to_steps) + 1,
            min(((of_range << (shift + more)) // step) >> to_steps, _MOST_WEIGHT - 1),
            min(((of_bend << (shift + more)) // step) >> to_steps, _MOST_WEIGHT - 1),
            min(of_near >> to_steps, _MOST_NEAR_WEIGHT),
            more,
        )
    return made
