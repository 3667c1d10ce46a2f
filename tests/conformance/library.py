"""Answer the conformance set by the package: python tests/conformance/library.py."""

import sys
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    tests = Path(__file__).parents[1]
    sys.path[:0] = [str(tests.parent / "src"), str(tests)]

import terrainwave
from conformance import protocol
from terrainwave.container.page import decode_error
from terrainwave.errors import CorruptStreamError, LimitExceededError, UnsupportedVersionError
from terrainwave.names import MESHES, METHODS

PROFILE = {
    "name": "terrainwave, Python",
    "methods": list(METHODS),
    "features": 31,
    "own": True,
    "meshes": list(MESHES[1:]),
    "blocks": True,
    "verifier": True,
    "digests": True,
}


def describe(terrain):
    """Return what a file says of itself."""
    header = terrain.header
    return {
        "rows": header.n_rows,
        "cols": header.n_cols,
        "levels": terrain.n_levels,
        "dtype": header.dtype,
        "method": header.method,
        "max_error": terrain.max_error,
        "effective_bound": terrain.effective_error,
        "metadata": header.metadata,
    }


def blocks_of(terrain, level):
    return terrain.grid.blocks(level)  # in Morton order


def block_codes(terrain, level):
    """Return box, E and mesh error of each block, in quanta."""
    return [
        (*terrain.box_quanta(block), *map(decode_error, terrain.container.codes(block)[2:]))
        for block in blocks_of(terrain, level)
    ]


def block_triangles(terrain, level):
    """Return the corners of the triangles of each block."""
    for block in blocks_of(terrain, level):
        mesh = terrain.block_mesh(block)
        vertices = np.stack([mesh.rows, mesh.cols, mesh.heights], axis=1).astype(np.int64)
        yield vertices[mesh.triangles]


def heights_of(terrain, level):
    """Return heights, with those that are fills, and which are no fills if the file has voids."""
    own = None
    if terrain.header.has_voids:
        own = terrain.read_with_mask(level=level, voids="exact")[1]
    return protocol.heights_and_mask(*terrain.read_with_mask(level=level, voids="any"), own)


def level_of(terrain, level):
    """Return all that the set knows of a level."""
    found = heights_of(terrain, level)
    found |= protocol.blocks(block_codes(terrain, level))
    if terrain.mesh_kind != "none":
        found |= protocol.mesh(block_triangles(terrain, level))
    return found


def root(terrain):
    """Return the root of a file's digests, if it has some."""
    found = terrain.digest()
    return {} if found is None else {"root": found}


def check(terrain):
    """Read all that there is."""
    for level in range(terrain.n_levels):
        level_of(terrain, level)
    for problem in terrain.check():
        raise CorruptStreamError(problem)
    return {"sound": True} | root(terrain)


def answer(question):
    """Answer one question."""
    task = question["task"]
    if task == "profile":
        return PROFILE
    try:
        with terrainwave.open(question["file"], threads=1) as terrain:
            if task == "describe":
                return describe(terrain)
            if task == "level":
                return heights_of(terrain, question["level"])
            if task == "blocks":
                return protocol.blocks(block_codes(terrain, question["level"]))
            if task == "mesh":
                return protocol.mesh(block_triangles(terrain, question["level"]))
            return check(terrain)
    except UnsupportedVersionError as error:
        return {"error": "unsupported", "message": str(error)}
    except CorruptStreamError as error:
        return {"error": "corrupt", "message": str(error)}
    except LimitExceededError as error:
        return {"error": "limit", "message": str(error)}


if __name__ == "__main__":
    protocol.answer_questions(answer)
