"""The protocol of the conformance set (tests/golden/README.md): digests, and questions by line."""

import hashlib
import json
import sys

import numpy as np


def digest(array):
    """Return SHA-256 of an array's numbers: row by row, little-endian."""
    array = np.ascontiguousarray(array)
    return hashlib.sha256(array.astype(array.dtype.newbyteorder("<")).tobytes()).hexdigest()


def heights_and_mask(heights, mask, own=None):
    """Return the answer to `level`; `own` of files that tell fills."""
    n_rows, n_cols = heights.shape
    found = {} if own is None else {"own": digest(np.asarray(own, dtype=np.uint8))}
    return {
        "rows": n_rows,
        "cols": n_cols,
        "heights": digest(heights),
        "mask": digest(np.asarray(mask, dtype=np.uint8)),
        **found,
    }


def blocks(codes):
    """Return the answer to `blocks`: a row (lowest, highest, E, mesh error) of each block."""
    return {"blocks": digest(np.array(codes, dtype=np.int64))}


def mesh(meshes):
    """Return the answer to `mesh`; arrays (n, 3, 3) of row, column, height of corners of blocks."""
    parts = []
    for triangles in meshes:
        corners = np.asarray(triangles, dtype=np.int64).reshape(-1, 3, 3)
        # The least corner first; turning a triangle does not turn it over.
        turned = [
            min(np.roll(one, -i, axis=0).ravel().tolist() for i in range(3)) for one in corners
        ]
        parts += [np.array([len(turned)]), np.array(sorted(turned), dtype=np.int64).ravel()]
    return {"mesh": digest(np.concatenate(parts).astype(np.int64))}


def answer_questions(answer):
    """Answer each line of stdin by one of stdout: `answer` gets the question, a dict."""
    for line in sys.stdin:
        print(json.dumps(answer(json.loads(line))), flush=True)
