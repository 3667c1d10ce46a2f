"""Answer the conformance set by the slow decoder, without meshes: python …/reference.py."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[1])]

import reference_decoder  # noqa: F401  # with all methods

from conformance import protocol
from terrainwave.reference.basics import CorruptError, UnsupportedError
from terrainwave.reference.digests import root_of, section_of
from terrainwave.reference.files import DTYPES, METHODS, block_codes, decode_error, read_file
from terrainwave.reference.units import decode, decode_with_own

PROFILE = {
    "name": "reference decoder",
    "methods": list(METHODS.values()),
    "features": 31,
    "own": True,
    "meshes": [],
    "blocks": True,
    "verifier": True,
    "digests": True,
}


def describe(file):
    """Return what a file says of itself."""
    header, scale = file.header, abs(file.metadata.get("scale", 1.0))
    return {
        "rows": header.n_rows,
        "cols": header.n_cols,
        "levels": file.grid.k_max + 1,
        "dtype": DTYPES[header.dtype],
        "method": METHODS[header.method],
        "max_error": header.max_error * scale,
        "effective_bound": header.effective_bound * scale,
        "metadata": file.metadata,
    }


def answer(question):
    """Answer one question."""
    task = question["task"]
    if task == "profile":
        return PROFILE
    data = Path(question["file"]).read_bytes()
    try:
        file = read_file(data)
        if task == "describe":
            return describe(file)
        if task == "level":
            heights, mask, own = decode_with_own(data, question["level"])
            has_voids = file.header.features & 1
            return protocol.heights_and_mask(heights, mask, own if has_voids else None)
        if task == "blocks":
            boxes, blocks = block_codes(data), file.grid.blocks(question["level"])
            return protocol.blocks(
                [(*boxes[block], decode_error(file.codes[block][3])) for block in blocks]
            )
        if task == "mesh":
            return {"error": "unsupported", "message": "meshes"}
        for level in range(file.grid.k_max + 1):
            heights, mask = decode(data, level)
        if not file.digests:
            return {"sound": True}
        if section_of(heights, mask) != file.digests:
            raise CorruptError("digests of other heights")
        root = root_of(file.header, file.metadata, heights.dtype.name, file.digests[:32])
        return {"sound": True, "root": root}
    except UnsupportedError as error:
        return {"error": "unsupported", "message": str(error)}
    except CorruptError as error:
        return {"error": "corrupt", "message": str(error)}


if __name__ == "__main__":
    protocol.answer_questions(answer)
