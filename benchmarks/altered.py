"""Altered files, found by `verify`: ``python -m benchmarks.altered``.

Forged files have other heights than the published ones, with checksums and digests that fit: each
is a raster with one sample moved, compressed as the published file was. `verify` with the published
root must find all. Damaged files are the published file with one bit turned: `verify` alone must
find each, or the bit changes no height.
"""

from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import terrainwave
from benchmarks import common
from terrainwave.errors import TerrainwaveError

Row = namedtuple("Row", "what method max_error n_files n_found n_without_change n_missed")
CASES = (("rapid", 0.0), ("rapid", 2.0), ("cdf97", 0.0), ("predictive", 2.0))
SIDE = 48


def raster(rng: np.random.Generator) -> np.ndarray:
    """Return a small raster of rough heights."""
    slopes = rng.normal(size=(SIDE, SIDE)).cumsum(0).cumsum(1)
    return np.rint(slopes).clip(-9000, 9000).astype(np.int16)


def is_found(path: Path, root: str | None) -> bool:
    """Say whether `verify` refuses a file."""
    try:
        return not terrainwave.verify(path, root=root, threads=1).ok
    except TerrainwaveError:
        return True


def forged(
    method: str, max_error: float, n_files: int, seed: int, folder: Path
) -> Iterator[tuple[Path, str]]:
    """Yield files of other heights, each with the root of what was published."""
    rng, path = np.random.default_rng(seed), folder / "forged.twz"
    for _ in range(n_files):
        heights = raster(rng)
        options = {"max_error": max_error, "method": method, "overwrite": True, "digest": True}
        terrainwave.compress(heights, path, **options)
        with terrainwave.open(path) as terrain:
            root, published = terrain.digest(), terrain.read()
        row, col = rng.integers(SIDE, size=2)
        while True:  # another height within the bound may be coded alike
            heights[row, col] += rng.integers(1, 4) + round(2 * max_error)
            terrainwave.compress(heights, path, **options)
            with terrainwave.open(path) as terrain:
                if not np.array_equal(terrain.read(), published):
                    break
        yield path, root


def damaged(method: str, max_error: float, n_files: int, seed: int, folder: Path) -> list[int]:
    """Return how many files with one bit turned are found, have the same heights, or neither."""
    rng, path = np.random.default_rng(seed), folder / "damaged.twz"
    data = terrainwave.compress_to_bytes(
        raster(rng), max_error=max_error, method=method, digest=True
    )
    with terrainwave.open(data) as terrain:
        heights = terrain.read()
    found = [0, 0, 0]
    for _ in range(n_files):
        bit = int(rng.integers(8 * len(data)))
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        if is_found(path, None):
            found[0] += 1
            continue
        with terrainwave.open(path) as terrain:
            found[1 if np.array_equal(terrain.read(), heights) else 2] += 1
    return found


@common.command("altered.csv")
@common.option("--forged", "n_forged", type=common.COUNT, default=1000)
@common.option("--damaged", "n_damaged", type=common.COUNT, default=10_000)
def main(n_forged: int, n_damaged: int, folder: Path, out: Path) -> None:
    """Alter, verify, print and write the CSV."""
    rows = []
    for seed, (method, max_error) in enumerate(CASES):
        n_files = n_forged // len(CASES)
        files = forged(method, max_error, n_files, seed, folder)
        n_found = sum(is_found(path, root) for path, root in files)
        rows.append(Row("forged", method, max_error, n_files, n_found, 0, n_files - n_found))
        n_files = n_damaged // len(CASES)
        found = damaged(method, max_error, n_files, seed, folder)
        rows.append(Row("damaged", method, max_error, n_files, *found))
    common.write_rows(out, rows)


if __name__ == "__main__":
    main()
