"""Golden files: what a file of each format version decodes to, now and for ever.

`tests/golden/vN/` holds files of format version N and `manifest.json`; `tools/make_golden.py` makes
those of the current version.
"""

import hashlib
from pathlib import Path

import numpy as np

import terrainwave

GOLDEN = Path(__file__).parent / "golden"


def sha256(*arrays):
    """Return the digest of shapes and values, little-endian, whatever the machine."""
    digest = hashlib.sha256()
    for array in arrays:
        array = np.ascontiguousarray(array)
        digest.update(f"{array.dtype.kind}{array.dtype.itemsize}{array.shape}".encode())
        digest.update(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()


def digests(path):
    """Return the digests of a file's bytes and of all it decodes to.

    `heights` and `mask` are of all levels, the coarsest first; `mesh`, of all blocks, is None where
    there is none.
    """
    data = Path(path).read_bytes()
    with terrainwave.open(data, threads=1) as terrain:
        levels = [terrain.read_with_mask(level=level) for level in range(terrain.n_levels)]
        found = {
            "file": hashlib.sha256(data).hexdigest(),
            "heights": sha256(*(heights for heights, _ in levels)),
            "mask": sha256(*(mask for _, mask in levels)),
            "mesh": None,
        }
        if terrain.mesh_kind != "none":
            blocks = [b for level in range(terrain.n_levels) for b in terrain.grid.blocks(level)]
            errors = np.array([terrain.mesh_error(block) for block in blocks])
            meshes = [array for block in blocks for array in terrain.block_mesh(block)]
            found["mesh"] = sha256(errors, *meshes)
    return found
