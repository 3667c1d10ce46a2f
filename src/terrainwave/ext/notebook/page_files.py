"""Files of the map in a notebook: those of the page, without a server."""

import gzip
import hashlib
from functools import cache
from pathlib import Path

from terrainwave.ext.publish import reader_directory

# The notebook's module replaces this file of the page, which says what it shows.
_HOST = "static/host.js"
_STATIC = Path(__file__).parents[1] / "serve" / "static"
_ENDINGS = (".html", ".css", ".js")


def widget_module() -> str:
    return (_notebook_directory() / "widget.js").read_text(encoding="utf-8")


@cache
def page_files() -> dict[str, bytes]:
    reader = reader_directory()
    paths = {f"static/{_below(_STATIC, path)}": path for path in _STATIC.rglob("*")}
    for name in ("src", "map"):
        folder = reader / name
        paths |= {f"terrainwave/{name}/{_below(folder, path)}": path for path in folder.iterdir()}
    paths |= {"index.html": paths.pop("static/index.html")}
    paths |= {_HOST: _notebook_directory() / "host.js"}
    return {
        name: gzip.compress(path.read_bytes(), mtime=0)
        for name, path in sorted(paths.items())
        if path.suffix in _ENDINGS
    }


@cache
def page_version() -> str:
    digest = hashlib.sha256()
    for name, packed in page_files().items():
        digest.update(name.encode() + packed)
    return digest.hexdigest()[:16]


def _notebook_directory() -> Path:
    return reader_directory() / "notebook"


def _below(folder: Path, path: Path) -> str:
    return path.relative_to(folder).as_posix()
