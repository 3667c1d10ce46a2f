"""Tables of the `cdf97` method, from its annex (docs/FORMAT.md §7.8)."""

import numpy as np
from numpy.typing import NDArray

from terrainwave.annexes import read_tables

# File written by tools/train_cdf97.py. A start value is the probability of a one in 1/4096 times
# 16, plus half the count.
ANNEX = "cdf97.bin"
LAYOUT = np.dtype([
    ("w", "<i2", (16, 4, 19)),
    ("W", "<i2", (8,)),
    ("residuals", "<u2", (1527,)),
    ("trees", "<u2", (4124,)),
    ("border", "<u2", (2860,)),
])  # fmt: skip

_TABLES = read_tables(ANNEX, LAYOUT)
# Weights of the residuals' prediction by set, phase and term, in 1/256; those of the expected
# magnitude, in 1/128.
TERM_WEIGHTS = _TABLES["w"].astype(np.int32)
E_WEIGHTS = _TABLES["W"].astype(np.int64)
_STARTS = {name: _TABLES[name].astype(np.uint32) for name in ("residuals", "trees", "border")}
_MODELS = {
    name: ((part >> 4) << 20 | (part & 15) * 2).astype(np.uint32) for name, part in _STARTS.items()
}


def start_residual_models() -> NDArray[np.uint32]:
    """Return fresh models of residuals with the trained start values."""
    return _MODELS["residuals"].copy()


def start_tree_models() -> NDArray[np.uint32]:
    """Return fresh models of labels and coefficients."""
    return _MODELS["trees"].copy()


def start_border_models() -> NDArray[np.uint32]:
    """Return fresh models of shared lines."""
    return _MODELS["border"].copy()
