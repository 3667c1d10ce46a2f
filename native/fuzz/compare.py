"""Hold `twz` against the Python library: python native/fuzz/compare.py TWZ [FILES [SEED]].

Files of any rasters and options, some with any tables of rapid and any corrections (`forced`), are
read by both as `tests/against_python.py` does. A file that differs stays where the message says.
"""

import contextlib
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

import terrainwave as tw

sys.path.append(str(Path(__file__).parents[1] / "tests"))

import forced
from against_python import disagreements

METHODS = ("rapid", "rapid", "rapid", "predictive", "predictive", "cdf97", "cdf53", "store")
PATCHABLE = ("rapid", "predictive")
DTYPES = ("int16", "int32", "float32", "float64", "uint8", "uint16")
NODATA = -9999


def any_heights(rng, dtype):
    """Return a raster: slopes, waves, steps and noise of any size; and whether it has voids."""
    n_rows, n_cols = rng.integers(1, 150, 2)
    row, col = np.mgrid[:n_rows, :n_cols]
    size = 10.0 ** rng.uniform(0.5, {"uint8": 1.6, "uint16": 4, "int16": 4}.get(dtype, 7))
    heights = (
        rng.normal() * row
        + rng.normal() * col
        + np.sin(row / 9) * np.cos(col / rng.uniform(3, 30)) * 30
    )
    heights += rng.normal(0, rng.choice([0.0, 0.3, 5.0]), heights.shape)
    heights += 20 * ((row // 7 + col // 11) % 3 == 0) * rng.integers(2)
    heights *= size / max(np.ptp(heights), 1)
    heights -= heights.min() * (np.dtype(dtype).kind == "u")
    heights = heights.astype(dtype)
    if np.dtype(dtype).kind == "u" or rng.random() < 0.4:
        return heights, False
    is_void = np.sin(row / rng.uniform(2, 20)) * np.cos(col / rng.uniform(2, 20)) > rng.uniform(
        0.2, 0.9
    )
    is_void |= rng.random(heights.shape) < rng.choice([0, 0.02])
    heights[is_void] = NODATA
    return heights, bool(is_void.any())


def write_any(path, seed):
    """Write a file; return its method and its feature bits."""
    rng = np.random.default_rng(seed)
    method, dtype = str(rng.choice(METHODS)), str(rng.choice(DTYPES))
    heights, has_voids = any_heights(rng, dtype)
    valid = heights[heights != NODATA] if has_voids else heights
    span = float(valid.max()) - float(valid.min()) if valid.size else 0.0
    is_lossy = rng.random() < 0.7
    is_lossy |= method == "cdf53" and dtype.startswith("float")  # it keeps none of them exactly
    options = {
        "block": int(rng.choice([32, 64])),
        "max_error": max(span * 10.0 ** rng.uniform(-5, -0.5), 1.0) if is_lossy else 0,
        "mesh": "none",
        "threads": 1,
    }
    rings = {} if method in ("rapid", "cdf53") else {"border_rings": int(rng.choice([1, 3]))}
    options["method"] = getattr(tw, method.capitalize())(**rings)
    if has_voids:
        options["nodata"] = NODATA
    with contextlib.ExitStack() as stack:
        if method == "rapid" and rng.random() < 0.8:
            stack.enter_context(forced.tables(rng))
        if method in PATCHABLE and is_lossy and rng.random() < 0.7:
            share = rng.choice([0.001, 0.02, 0.3, 1.0])
            stack.enter_context(forced.corrections(share, int(rng.integers(1 << 16))))
        tw.compress(heights, path, **options)
    features = int.from_bytes(path.read_bytes()[12:16], "little")
    return [method, *(f"{method}, feature bit {bit}" for bit in range(8) if features >> bit & 1)]


def main():
    """Compare files until one differs."""
    twz, *numbers = sys.argv[1:]
    n_files, seed = (*map(int, numbers), *(100, 1)[len(numbers) :])
    folder, met = Path(tempfile.mkdtemp(prefix="native-compare-")), Counter()
    for number in range(seed, seed + n_files):
        path = folder / f"{number}.twz"
        met.update(write_any(path, number))
        found = list(disagreements(twz, str(path)))
        if found:
            sys.exit("\n".join(found))
        path.unlink()
    folder.rmdir()
    print(
        f"{n_files} files, the same by both:",
        ", ".join(f"{n} {what}" for what, n in sorted(met.items())),
    )


if __name__ == "__main__":
    main()
