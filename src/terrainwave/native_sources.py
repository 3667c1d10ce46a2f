"""Place and sources of the native library: what builds it and what loads it agree here.

The library lies in the package's folder. It holds the digest of the sources that it was built of,
so that one of other sources is not used. In a clone the sources say which digest is expected,
elsewhere the note that the build has put beside the library. Builds load this file by itself: it
imports nothing of the package.
"""

import hashlib
import json
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
NAME = {"win32": "terrainwave.dll", "darwin": "libterrainwave.dylib"}.get(
    sys.platform, "libterrainwave.so"
)
LIBRARY = FOLDER / NAME
NOTE = FOLDER / "native.json"  # of the build: {"sources": digest}, or {"missing": the reason}

# Files and folders that the library is built of, from the root of a clone.
SOURCES = (
    "native/CMakeLists.txt",
    "native/include",
    "native/python",
    "native/src",
    "src/terrainwave/annexes",
)
_SUFFIXES = {".bin", ".c", ".h", ".txt"}


def source_files(root: Path) -> list[Path]:
    """Return the files that the library is built of, in the order of their names."""
    found: list[Path] = []
    for name in SOURCES:
        path = root / name
        found += [path] if path.is_file() else path.iterdir()
    return sorted(path for path in found if path.suffix in _SUFFIXES)


def digest_of(root: Path) -> str:
    """Return the digest of the sources in a clone or an unpacked sdist, 16 hexadecimal digits.

    Raises
    ------
    OSError
        If a file is missing or cannot be read.
    """
    digest = hashlib.sha256()
    for path in source_files(root):
        data = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()} {len(data)}\n".encode())
        digest.update(data)
    return digest.hexdigest()[:16]


def clone() -> Path | None:
    """Return the root of the clone that the package lies in; None if it is installed."""
    root = FOLDER.parents[1]
    return root if (root / "native" / "python" / "shim.c").is_file() else None


def expected_digest() -> str | None:
    """Return the digest that the library should hold; None if the build has left none."""
    root = clone()
    return digest_of(root) if root else read_note().get("sources")


def read_note() -> dict[str, str]:
    """Return what the build has noted; nothing if there is no note."""
    try:
        return dict(json.loads(NOTE.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}
