"""Pack the conformance set: ``python tools/make_conformance.py TARGET.zip``; the same bytes always.

The files of tests/golden with their manifest, the program that asks a reader, the documents of the
format, and its annexes: all that another implementation needs.
"""

import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
NAME = "terrainwave-conformance-1.0"
_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip can hold


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
