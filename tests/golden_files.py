"""Golden files: what a file of each format version decodes to.

`tests/golden/vN/` holds files of format version N and `manifest.json`, as tests/golden/README.md
says; `tools/make_golden.py` makes those of the current version.
"""

import hashlib
from pathlib import Path

from conformance import invalid, library

import terrainwave

GOLDEN = Path(__file__).parent / "golden"
OF_LEVEL = ("rows", "cols", "heights", "mask", "own")


def sha256(path):
    """Return the digest of a file's bytes."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def found(path):
    """Return what the manifest says of a file, but for its purpose: all that it decodes to."""
    with terrainwave.open(path, threads=1) as terrain:
        header = terrain.header
        return {
            "sha256": sha256(path),
            "features": header.features,
            "mesh": header.mesh,
            "block": header.block,
            "border_rings": header.border_rings,
            "step": header.step,
            **library.describe(terrain),
            **library.root(terrain),
            "level": [library.level_of(terrain, level) for level in range(terrain.n_levels)],
        }


def digests(path):
    """Return size and digests of heights and mask of each level, as js/testing/levels.js does."""
    return [{key: level[key] for key in OF_LEVEL if key in level} for level in found(path)["level"]]


def found_invalid(path):
    """Return what the manifest says of an invalid file."""
    path = Path(path)
    return {"sha256": sha256(path), **invalid.entry(path.name, path.read_bytes())}
