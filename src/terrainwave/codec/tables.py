"""Stencils and start values of the `predictive` method (FORMAT.md: annexes)."""

import numpy as np

from terrainwave.codec.lattice import HH, HL, LH, TAPS


def _first(pass_):
    w = np.zeros((1, TAPS[pass_].shape[0]), dtype=np.int64)
    if pass_ == HH:
        for k, v in zip((9, 10, 13, 14), (1024,) * 4): w[0, k] = v
    else:
        w[0, 4:8] = 1024
    return w

STENCILS = {HH: _first(HH), HL: _first(HL), LH: _first(LH)}
E_WEIGHTS = {p: np.array([12,4,12,4,6,2,2,1,0,1,4,2,1,1,1,64]) for p in (HH, HL, LH)}
E_WEIGHTS = {p: v.astype(np.int64) for p, v in E_WEIGHTS.items()}
def start_models(n):
    from terrainwave.coding.rangecoder import new_models
    return new_models(n)
