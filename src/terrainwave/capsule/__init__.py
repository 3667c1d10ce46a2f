"""Capsules: a .twz file with everything that it takes to read it, in a ZIP archive.

An archive must be readable when terrainwave and its servers are gone. A capsule has the file, the
description of its format with all annexes, a reader as C source, and checksums.
"""

import hashlib
import os
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from terrainwave._version import __version__
from terrainwave.arguments import check_ending
from terrainwave.capsule.amalgamation import amalgamate
from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.targets.publication import publish
from terrainwave.errors import CorruptStreamError, StorageError
from terrainwave.native_sources import clone
from terrainwave.progress import ProgressCallback
from terrainwave.terrain import Terrain
from terrainwave.verification.heights import verify

ENDINGS = (".zip",)
_ANNEXES = Path(__file__).parents[1] / "annexes"
_CHUNK = 1 << 20
# ZIP has no time zones and begins in 1980. Equal capsules have equal bytes.
_NO_TIME = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Capsule:
    """A capsule that was written.

    Attributes
    ----------
    path : str
    n_bytes : int
    root : str or None
        Root of the heights (FORMAT.md §4.9); None if the file has no digests.
    """

    path: str
    n_bytes: int
    root: str | None


def write_capsule(
    twz: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> Capsule:
    """Write a .twz file with its format, a reader and checksums to a ZIP archive.

    The file is checked before: all checksums, every block, and the digests of its heights.

    Parameters
    ----------
    twz : path
        The file, or its URL.
    target : path
        The archive; it ends in ``.zip``.
    overwrite : bool
        Replace an existing archive.
    threads : int, optional
        Number of threads of the check; by default all available processors.
    progress : callable, optional
        Called with the state of the check (`Progress`).

    Raises
    ------
    CorruptStreamError
        If the file is damaged.
    StorageError
        If a file cannot be read or written, or the target exists.
    """
    check_ending(target, ENDINGS)
    report = verify(twz, threads=threads, progress=progress)
    if not report.ok:
        raise CorruptStreamError(
            f"{os.fspath(twz)} is damaged: {report.problems[0]}; a capsule would archive the damage"
        )
    with Terrain(twz) as terrain:
        _write(terrain, target, report.root, overwrite)
        return Capsule(os.fspath(target), os.path.getsize(target), report.root)


def decoder_sources() -> dict[str, str]:
    """Return the C reader by the names of its files: library, header, and the command ``twz``.

    Raises
    ------
    StorageError
        If the installation lacks them.
    """
    native = _sources() / "native"
    return {
        "terrainwave.c": amalgamate(native, __version__),
        "terrainwave.h": _text(native / "include" / "terrainwave.h"),
        "twz.c": _text(native / "cli" / "twz.c"),
    }


def _sources() -> Path:
    """Return the folder that has `native` and `docs`: of a clone, or of the installed package."""
    return clone() or Path(__file__).parent / "sources"


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise StorageError(
            f"{path}: {error.strerror}; install terrainwave again, with its data files"
        ) from None


def _write(
    terrain: Terrain, target: str | os.PathLike[str], root: str | None, overwrite: bool
) -> None:
    # As Terrain names it; a URL may end in a query.
    name = Path(str(terrain.name).split("?")[0]).name
    name = name if name.endswith(".twz") else f"{name}.twz"
    folder = f"{Path(target).stem}/"
    sums = []
    with publish(target, overwrite) as part, zipfile.ZipFile(part.file, "w") as archive:
        for path, chunks in _contents(terrain, name, root):
            digest = hashlib.sha256()
            # Heights are compressed already.
            is_stored = path == name
            info = zipfile.ZipInfo(folder + path, _NO_TIME)
            info.compress_type = zipfile.ZIP_STORED if is_stored else zipfile.ZIP_DEFLATED
            info.external_attr = 0o644 << 16
            with archive.open(info, "w", force_zip64=is_stored) as entry:
                for chunk in chunks:
                    digest.update(chunk)
                    entry.write(chunk)
            sums.append(f"{digest.hexdigest()}  {path}\n")
        info = zipfile.ZipInfo(f"{folder}SHA256SUMS", _NO_TIME)
        info.external_attr = 0o644 << 16
        archive.writestr(info, "".join(sums))


def _contents(
    terrain: Terrain, name: str, root: str | None
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the files of a capsule: path, and bytes in pieces."""
    docs = _sources() / "docs"
    yield "README.txt", [_readme(terrain, name, root).encode()]
    yield name, _pieces(terrain.container.source)
    for document in (docs / "FORMAT.md", *sorted(docs.glob("format-*.md"))):
        yield f"format/{document.name}", [_text(document).encode()]
    for annex in sorted(_ANNEXES.iterdir()):
        if annex.suffix in (".bin", ".txt"):
            yield f"format/annexes/{annex.name}", [annex.read_bytes()]
    for path, text in decoder_sources().items():
        yield f"decoder/{path}", [text.encode()]
    yield "LICENSE", [_text(_sources() / "LICENSE").encode()]


def _pieces(source: ByteSource) -> Iterator[bytes]:
    for start in range(0, source.size, _CHUNK):
        yield source.read(start, min(_CHUNK, source.size - start))


def _readme(terrain: Terrain, name: str, root: str | None) -> str:
    info = terrain.info()
    units = " ".join((info.units or "").split())
    if info.effective_error == 0:
        bound = "They are exactly those of the original."
    else:
        side = {"above": ", none below it", "below": ", none above it"}.get(info.bound, "")
        bound = f"Each is within {info.effective_error:.9g} {units}".rstrip()
        bound += f" of the original{side}."
    if not info.proved:
        bound += "\nThis was not proved when the file was made (--no-verify)."
    return _text(Path(__file__).with_name("readme.txt")).format(
        name=name,
        line="=" * len(f"{name}: heights that anybody can read"),
        n_rows=info.n_rows,
        n_cols=info.n_cols,
        dtype=info.dtype,
        method=info.method,
        bound=bound,
        crs=" ".join((info.crs or "unknown").split()),
        transform=" ".join(f"{number:.17g}" for number in info.transform),
        units=units or "unknown",
        root=root or "none: the file has no digests (compress it with --digest)",
        scale=f"{info.scale:.17g}",
        offset=f"{info.offset:.17g}",
        in_unit=f" {units}" if units else "",
    )
