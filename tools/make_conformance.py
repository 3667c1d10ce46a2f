"""Pack the conformance set: ``python tools/make_conformance.py TARGET.zip``; the same bytes always.

The files of tests/golden with their manifest, the program that asks a reader, the documents of the
format, and its annexes: all that another implementation needs.
"""

import base64
import json
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "src"))

from terrainwave.codec.rapid import trained as rapid_tables  # noqa: E402
from terrainwave.codec.rapid import trained_reach as rapid_reach_tables  # noqa: E402

NAME = "terrainwave-conformance-1.0"
PLANES = {1: "HH", 2: "HL", 3: "LH"}
_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip can hold


def numbers(packed: str, kind: str, shape: tuple[int, ...] = (-1,)) -> list:
    """Return the numbers that an annex holds deflated and in base 85 (P.9)."""
    data = zlib.decompress(base64.b85decode(packed))
    return np.frombuffer(data, dtype=kind).reshape(shape).tolist()


def annexes() -> dict[str, dict]:
    """Return the tables of R.10, by file."""

    def by_plane(table):
        return {PLANES[plane]: np.asarray(rows).tolist() for plane, rows in table.items()}

    return {
        "rapid": {
            "STENCILS": by_plane(rapid_tables.STENCILS),
            "FEATURES": np.asarray(rapid_tables.FEATURES).tolist(),
            "CODES": numbers(rapid_tables._CODES, "u1", (6, 176, 63)),
            "REACH_CODES": numbers(rapid_reach_tables._CODES, "u1", (6, 176, 63)),
        },
    }


def contents() -> dict[str, bytes]:
    """Return {name in the zip: bytes}."""
    golden = ROOT / "tests" / "golden"
    files = {
        path.relative_to(golden).as_posix(): path.read_bytes()
        for path in golden.rglob("*")
        if path.suffix in (".twz", ".json", ".md")
    }
    files["run_conformance.py"] = (ROOT / "tools" / "run_conformance.py").read_bytes()
    files["LICENSE"] = (ROOT / "LICENSE").read_bytes()
    for path in (ROOT / "docs" / "FORMAT.md", *(ROOT / "docs").glob("format-*.md")):
        files[f"format/{path.name}"] = path.read_bytes()
    for pattern in ("*.bin", "*.txt"):
        for path in (ROOT / "src" / "terrainwave" / "annexes").glob(pattern):
            files[f"annexes/{path.name}"] = path.read_bytes()
    for name, table in annexes().items():
        text = json.dumps(table, separators=(",", ":"))
        files[f"tables/{name}.json"] = text.encode() + b"\n"
    return {f"{NAME}/{name}": files[name] for name in sorted(files)}


def main(target: Path) -> None:
    """Write the zip, not deflated: that would depend on the machine's zlib."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in contents().items():
            archive.writestr(zipfile.ZipInfo(name, _TIME), data)
    print(f"{target}: {target.stat().st_size:,} bytes; README.md in it says how to use it")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
