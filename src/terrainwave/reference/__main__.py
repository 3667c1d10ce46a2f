"""Decode a .twz file slowly: ``python -m terrainwave.reference FILE.twz OUT.npy``.

Writes the raw heights of the full grid (§2.3) to OUT.npy and their validity to OUT.valid.npy, and
prints the root of the heights (§4.9).
"""

import sys
from pathlib import Path

import numpy as np

from terrainwave.reference.basics import CorruptError, UnsupportedError
from terrainwave.reference.digests import digests_of, root_of, top_height
from terrainwave.reference.files import DTYPES, read_file
from terrainwave.reference.units import decode


def main() -> None:
    if len(sys.argv) != 3 or not sys.argv[2].endswith(".npy"):
        raise SystemExit("usage: python -m terrainwave.reference FILE.twz OUT.npy")
    path, out = map(Path, sys.argv[1:])
    try:
        data = path.read_bytes()
        heights, valid = decode(data)
        file = read_file(data)
    except OSError as error:
        raise SystemExit(f"{path}: {error.strerror}") from None
    except CorruptError as error:
        kind = "not supported" if isinstance(error, UnsupportedError) else "corrupt"
        raise SystemExit(f"{path} is {kind}: {error}") from None
    np.save(out, heights)
    np.save(out.with_suffix(".valid.npy"), valid)
    top = digests_of(heights, valid)[top_height(heights.shape), 0, 0]
    sys.stdout.write(f"{root_of(file.header, file.metadata, DTYPES[file.header.dtype], top)}\n")


main()
