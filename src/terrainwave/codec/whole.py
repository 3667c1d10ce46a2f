"""Masks of units without voids: views of one memory, so that nobody needs to look at each sample.

Most units have none, and each is asked about several times on its way to a reader.
"""

from typing import cast

import numpy as np

from terrainwave.codec.refiner import Mask

_START = 1 << 19  # as many as a unit of 512 samples a side has, and more


def _valid_samples(n: int) -> Mask:
    valid = np.ones(n, dtype=np.bool_)
    valid.flags.writeable = False
    return valid


_valid = _valid_samples(0)


def all_valid(shape: tuple[int, int]) -> Mask:
    """Return the mask of a unit without voids; it is shared, and nobody's to write to."""
    global _valid
    size = shape[0] * shape[1]
    valid = _valid
    if valid.size < size:
        valid = _valid = _valid_samples(max(size, _START))
    return valid[:size].reshape(shape)


def is_whole(mask: Mask) -> bool:
    """Say whether all samples of a mask are valid, at once of what `all_valid` made and its views.

    (Masks made before a larger unit came are looked at.)
    """
    return mask.base is _valid or cast(bool, mask.all())
