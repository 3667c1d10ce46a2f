"""Train the start values of the mask coder from a directory of rasters.

    python tools/train_masks.py DIR [--leave-out NAME]

Prints what stands in `terrainwave.codec.masks` and, for each raster, the bytes that its masks
take with these start values. Start values in use are never edited: an annex of the format.
"""

import argparse
import base64
import tempfile
from pathlib import Path
from unittest.mock import patch

import numpy as np

import terrainwave
from terrainwave.codec import masks as maskcoder
from terrainwave.codec.masks import encode_mask, pad_implied, row_contexts

WIDTH = 88
# A bound so large that coding heights takes no time.
MAX_ERROR = 1000


def masks_of(path):
    """Return (mask, implied) of all units of a raster that have a mask section."""
    found = []

    def record(mask, implied):
        found.append((mask.copy(), implied.copy()))
        return encode_mask(mask, implied)

    with (
        tempfile.TemporaryDirectory() as folder,
        patch("terrainwave.codec.group.encode_mask", record),
    ):
        target = Path(folder) / "masks.twz"
        terrainwave.compress(path, target, max_error=MAX_ERROR, mesh="none", verify=False)
    return found


def count(masks):
    """Return how often each model saw a 0 and a 1."""
    counts = np.zeros((maskcoder.N_MASK_MODELS, 2))
    for mask, implied in masks:
        n_rows, n_cols = mask.shape
        padded = np.zeros((n_rows + 2, n_cols + 3), dtype=np.bool_)
        padded[2:, 2:-1] = mask
        ahead = pad_implied(implied)
        contexts = np.zeros(n_cols, dtype=np.int64)
        for row in range(n_rows):
            row_contexts(padded, ahead, row, contexts)
            west = 32 * padded[row + 2, 1:-2].astype(int) + 2 * padded[row + 2, :-3].astype(int)
            models = contexts + west * (maskcoder.N_MASK_MODELS // 64)
            coded = ~implied[row]
            np.add.at(counts, (models[coded], mask[row, coded].astype(int)), 1)
    return counts


def start_values(counts):
    """Return probabilities in 1/256 from counts by raster, each raster with the same weight.

    Contexts hardly seen lean on those with the same neighbours.
    """
    total = sum(part / part.sum() * 1e5 for part in counts).reshape(64, -1, 2)
    total += 0.05 * total.mean(1, keepdims=True) + 0.4
    return np.clip(np.rint(256 * total[..., 1] / total.sum(2)), 1, 255).astype(np.uint8).ravel()


def main():
    """Train, print the table and the sizes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--leave-out", help="name of a raster not to train with")
    arguments = parser.parse_args()
    masks = {path.stem: masks_of(path) for path in sorted(arguments.directory.glob("*.tif"))}
    masks = {name: found for name, found in masks.items() if found}
    starts = start_values(
        [count(found) for name, found in masks.items() if name != arguments.leave_out]
    )
    text = base64.b85encode(starts.tobytes()).decode()
    for first in range(0, len(text), WIDTH):
        print(f'    "{text[first : first + WIDTH]}"')
    models = starts.astype(np.uint32) << 24 | maskcoder.START_COUNT
    with patch.object(maskcoder, "start_models", lambda: models.copy()):
        for name, found in masks.items():
            print(name, sum(len(encode_mask(*unit)) for unit in found), "bytes")


if __name__ == "__main__":
    main()
