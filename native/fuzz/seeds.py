"""Write small sound files of every method as seeds of fuzzers: python native/fuzz/seeds.py FOLDER.

Units of few samples decode in microseconds, so that fuzzers try many inputs.
"""

import contextlib
import sys
from pathlib import Path

import forced
import numpy as np

import terrainwave as tw

SIZES = ((5, 5), (4, 34), (35, 3), (2, 67), (34, 34))
METHODS = ("rapid", "predictive", "cdf97", "cdf53", "store")


def heights_of(n_rows, n_cols, dtype, has_voids):
    """Return a hill with a step in it, and a hole if asked for."""
    row, col = np.mgrid[:n_rows, :n_cols]
    heights = 300 + 7 * row - 3 * col + (row * col) % 5 + 40 * (col > n_cols // 2)
    if np.issubdtype(dtype, np.floating):
        heights = heights * np.sqrt(2) + 0.37 * row
    heights = heights.astype(dtype)
    if has_voids:
        heights[n_rows // 2 :, n_cols // 3 : n_cols // 2 + 1] = -9999
    return heights


def variants(method):
    """Yield (name, dtype, has_voids, options of compress); `main` knows some of the names."""
    own = getattr(tw, method.capitalize())
    rings = {} if method == "rapid" else {"border_rings": 3}
    yield "lossless", np.int16, False, {"max_error": 0}
    yield "voids", np.int16, True, {"max_error": 2, "nodata": -9999}
    yield "exact-voids", np.int32, True, {"max_error": 0, "nodata": -9999}
    if method != "cdf53":
        yield (
            "coarse",
            np.float32,
            True,
            {"max_error": 5, "nodata": -9999, "method": own(**rings)},
        )
        yield "exact", np.float32, False, {"max_error": 0}
    if method == "rapid":
        yield "weights", np.int16, False, {"max_error": 0}
        yield "wide-weights", np.int32, False, {"max_error": 2e6, "method": own(**rings)}
    if method in ("rapid", "predictive"):
        yield "corrected", np.int16, True, {"max_error": 2, "nodata": -9999}
        yield (
            "wide-corrected",
            np.int32,
            True,
            {"max_error": 2e6, "nodata": -9999, "method": own(**rings)},
        )


def main():
    """Write the files, and `files.txt` that names them."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for method in METHODS:
        for name, dtype, has_voids, options in variants(method):
            # Some files have several segments.
            tall = ((1100, 2),) if method in ("store", "cdf53") and name == "lossless" else ()
            for n_rows, n_cols in SIZES + tall:
                path = folder / f"{method}-{name}-{n_rows}x{n_cols}.twz"
                heights = heights_of(n_rows, n_cols, dtype, has_voids)
                if "wide" in name:
                    heights = np.where(heights == -9999, heights, heights * 10**6 + heights % 7)
                try:
                    with contextlib.ExitStack() as stack:
                        if "weights" in name:
                            rng = np.random.default_rng(n_rows)
                            stack.enter_context(forced.tables(rng))
                        if "corrected" in name:
                            stack.enter_context(forced.corrections(0.1, n_rows))
                        options = {"method": method, "block": 32, "overwrite": True} | options
                        tw.compress(heights, path, **options)
                except tw.TerrainwaveError as error:
                    print(f"{path.name}: {error}")
                    continue
                paths.append(str(path))
    (folder / "files.txt").write_text("\n".join(paths) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
