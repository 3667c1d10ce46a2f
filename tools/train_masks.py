"""Train the frequencies of masks from a directory of rasters, and from drawn masks.

    python tools/train_masks.py DIR masks.bin [--leave-out NAME]

Prints the bytes that the masks of each take. The result is the annex of FORMAT.md §5.2; a file that
is in use is never changed.
"""

import argparse
import tempfile
from pathlib import Path
from unittest.mock import patch

import numpy as np

import terrainwave
from terrainwave.codec import masks

# A bound so large that coding heights takes no time.
MAX_ERROR = 1000
SIDE = 513
TURNS = 30
# What a drawn mask weighs against a raster.
DRAWN = 0.1


def drawn():
    """Yield names and masks of kinds that rasters have."""
    rng = np.random.default_rng(0)
    row, col = np.indices((SIDE, SIDE))
    for share in (0.0001, 0.001, 0.01, 0.03, 0.06, 0.1, 0.2, 0.3, 0.5):
        specks = rng.random((SIDE, SIDE)) < share
        yield f"void specks {share}", ~specks
        yield f"valid specks {share}", specks
    for n in range(1, 9):
        field = sum(
            rng.normal() * np.cos(rng.normal(0, n, 2) @ (row.ravel(), col.ravel()) / 60 + k)
            for k in range(40)
        ).reshape(row.shape)
        yield f"coast {n}", field > rng.normal()
    for n in range(6):
        angle = rng.random() * np.pi
        across = (np.cos(angle) * row + np.sin(angle) * col) / SIDE
        yield f"swath {n}", (across > rng.random() / 2) & (across < 1.3)
    for n in range(4):
        valid = np.full((SIDE, SIDE), n % 2 == 0)
        for top, left, height, width in rng.integers(1, 100, (12, 4)):
            valid[5 * top : 5 * top + height, 5 * left : 5 * left + width] = n % 2
        yield f"rectangles {n}", valid


def counts_of(source):
    """Return how often each model saw a 0 and a 1, of each unit of a raster."""
    found = []

    def count(models, bits):
        counts = np.bincount(2 * models.astype(int) + bits, minlength=2 * masks.N_MODELS)
        found.append(counts.reshape(-1, 2))
        return b"\0"

    with tempfile.TemporaryDirectory() as folder, patch.object(masks, "_packed", count):
        target = Path(folder) / "masks.twz"
        terrainwave.compress(
            source, target, max_error=MAX_ERROR, mesh="none", method="store", verify=False
        )
    return found


def bits_of(counts, freqs):
    """Return the bits that units take by each set: shape (units, sets)."""
    return counts[..., 1] @ -np.log2(freqs / masks.N_SLOTS).T + (
        counts[..., 0] @ -np.log2(1 - freqs / masks.N_SLOTS).T
    )


def trained(counts, weights, n_sets):
    """Return frequencies by set: each unit takes the set that suits it, each set its units' shares.

    All units of a raster have the same weight together. What a set has hardly seen leans on all.
    """
    bits = counts.sum((1, 2))
    of_all = np.einsum("u,umb->mb", weights / np.maximum(bits, 1), counts)
    prior = of_all / of_all.sum(1, keepdims=True).clip(1e-9)
    prior = 0.9 * prior + 0.05
    # Begin with units that lie far apart: by how well the mean suits them.
    order = np.argsort(bits_of(counts, _rounded(prior[None, :, 1]))[:, 0] / np.maximum(bits, 1))
    chosen = np.empty(len(order), dtype=int)
    chosen[order] = np.arange(len(order)) * n_sets // len(order)
    for _ in range(TURNS):
        freqs = []
        for k in range(n_sets):
            mine = chosen == k
            seen = np.einsum("u,umb->mb", weights[mine] / np.maximum(bits[mine], 1), counts[mine])
            seen = seen / max(seen.sum(), 1e-9) * 1e6 + 2 * prior
            freqs.append(_rounded(seen[:, 1] / seen.sum(1)))
        freqs = np.array(freqs)
        chosen = bits_of(counts, freqs).argmin(1)
    return freqs


def _rounded(shares):
    return np.clip(np.rint(shares * masks.N_SLOTS), 1, masks.N_SLOTS - 1).astype(np.uint32)


def annex(samples, groups):
    """Return the bytes of the annex (§5.2); a list with a number that does not fit raises."""
    parts = np.zeros((), masks.LAYOUT)
    parts["samples"], parts["groups"] = samples.tolist(), groups.tolist()
    return parts.tobytes()


def main():
    """Train, write the annex, print sizes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--leave-out", help="name of a raster not to train with")
    arguments = parser.parse_args()
    found = {path.stem: counts_of(path) for path in sorted(arguments.directory.glob("*.tif"))}
    real = set(found)
    for name, valid in drawn():
        found[name] = counts_of(np.where(valid, np.float32(1), np.float32(np.nan)))
    found = {name: np.array(counts) for name, counts in found.items() if counts}
    used = [counts for name, counts in found.items() if name != arguments.leave_out]
    counts = np.concatenate(used)
    # Those of real rasters count more.
    weights = np.concatenate(
        [
            np.full(len(part), (1 if name in real else DRAWN) / len(part))
            for name, part in found.items()
            if name != arguments.leave_out
        ]
    )
    parts = (np.s_[:, : masks.FIRST_OF_GROUPS], np.s_[:, masks.FIRST_OF_GROUPS :])
    sets = [
        trained(counts[part], weights, n)
        for part, n in zip(parts, (masks.N_SETS, masks.N_GROUP_SETS), strict=True)
    ]
    arguments.out.write_bytes(annex(*sets))
    for name, counts in found.items():
        bits = sum(bits_of(counts[part], freqs).min(1) for part, freqs in zip(parts, sets))
        print(f"{name}: {bits.sum() / 8:.0f} bytes in {len(counts)} units")


if __name__ == "__main__":
    main()
