"""Tables of the `predictive` method, from its annex (docs/format-predictive.md P.9).

Stencils and weights of the expected magnitude are by plane, 1 HH, 2 HL, 3 LH.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.annexes import read_tables

# File written by tools/train_stencils.py. A start value is the probability of a one in 1/4096 times
# 16, plus half the count.
ANNEX = "predictive.bin"
LAYOUT = np.dtype([
    ("HH", "<i2", (8, 20)),
    ("HL", "<i2", (8, 20)),
    ("LH", "<i2", (8, 24)),
    ("W", "<i2", (3, 3, 18)),
    ("starts", "<u2", (25791,)),
])  # fmt: skip

_TABLES = read_tables(ANNEX, LAYOUT)
STENCILS = {i: _TABLES[plane].astype(np.int64) for i, plane in enumerate(("HH", "HL", "LH"), 1)}
E_WEIGHTS = dict(enumerate(_TABLES["W"].astype(np.int64), 1))
_STARTS = _TABLES["starts"].astype(np.uint32)
_MODELS = ((_STARTS >> 4) << 20 | (_STARTS & 15) * 2).astype(np.uint32)


def start_models(n_models: int) -> NDArray[np.uint32]:
    """Return fresh models with the trained start values."""
    return _MODELS[:n_models].copy()


def start_border_models(n_models: int) -> NDArray[np.uint32]:
    """Return fresh models of shared lines; they follow the others."""
    return _MODELS[-n_models:].copy()
