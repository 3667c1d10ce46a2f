"""Coded size against the ideal code length of the same decisions.

Whole payloads of terrain-like heights are encoded by the real kernels, then decoded by the same
code as plain Python with accounts (`tests/decisions.py`), which says what is ideal.
"""

import json
import subprocess
import sys

import numpy as np
import pytest
from commands import environment
from lone_units import lone_spec

from terrainwave.codec.registry import refiner_by_name
from terrainwave.coding.filters import lowpass_analysis

SHAPE = (129, 129)
# Bytes: the header of the payload (step, flags), the last byte of the coder, rounding up to bytes.
HEADER_AND_END = {"predictive": 3, "cdf97": 6}


def fractal(shape, seed=4):
    """Return whole metres with a spectrum like terrain's: amplitudes fall as f^-2."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(rng.normal(size=shape))
    rows, cols = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    frequency = np.hypot(rows, cols)
    frequency[0, 0] = 1
    heights = np.fft.irfft2(spectrum / frequency**2, s=shape)
    return np.rint(heights * (120 / heights.std())).astype(np.int32)


@pytest.fixture(scope="module")
def accountant():
    """Return the program `decisions`: one interpreter decodes all payloads."""
    with subprocess.Popen(
        [sys.executable, "-m", "decisions"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment(NUMBA_DISABLE_JIT="1"),
    ) as process:
        yield process


def account(accountant, tmp_path, method, step, has_parent):
    """Encode a unit; return the payload's bytes and the accounts of its decisions."""
    target = fractal(SHAPE)
    parent = None
    if has_parent:
        size = ((SHAPE[0] + 1) // 2, (SHAPE[1] + 1) // 2)
        parent = lowpass_analysis(target, (0, 0), SHAPE, (0, 0), size)
        if method == "predictive":
            parent = np.ascontiguousarray(target[::2, ::2])
        np.save(tmp_path / "case.npy", parent)
    spec = lone_spec(SHAPE, step, parent=has_parent)
    mask = np.ones(SHAPE, dtype=bool)
    payload, heights, _ = refiner_by_name(method).encode(spec, parent, target, mask)
    options = {"method": method, "step": step, "shape": SHAPE, "has_parent": has_parent}
    (tmp_path / "case.json").write_text(json.dumps(options), encoding="utf-8")
    (tmp_path / "case.bin").write_bytes(payload)
    print(tmp_path / "case", file=accountant.stdin, flush=True)
    accounts = json.loads(accountant.stdout.readline())
    assert accounts["checksum"] == int(heights.astype(np.int64).sum())
    return len(payload), accounts


@pytest.mark.full
@pytest.mark.parametrize(("step", "has_parent"), [(1, True), (7, False)])
@pytest.mark.parametrize("method", ["predictive", "cdf97"])
def test_coded_size_is_within_one_percent_of_the_ideal(
    accountant, tmp_path, method, step, has_parent
):
    n_bytes, accounts = account(accountant, tmp_path, method, step, has_parent)
    coded = 8 * (n_bytes - HEADER_AND_END[method])
    own, ideal = accounts["raw"] + accounts["own"], accounts["raw"] + accounts["ideal"]
    print(
        f"{method} n={step} parent={has_parent}: {n_bytes} bytes,"
        f" {100 * (8 * n_bytes / own - 1):+.3f} % over the models' own probabilities,"
        f" {100 * (8 * n_bytes / ideal - 1):+.3f} % over exact counts"
    )
    assert accounts["n_decisions"] > SHAPE[0] * SHAPE[1] / 8
    # The arithmetic coder alone: it rounds a probability to 16 bits, a range to 24 at least.
    assert coded <= 1.0005 * own
    # With what estimating from rounded, forgetting counts costs.
    assert coded <= 1.01 * ideal
    # No decision was missed.
    assert 8 * n_bytes >= 0.9999 * own
