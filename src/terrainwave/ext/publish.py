"""Folders for static web servers: the page of `serve`, .twz files, and the JavaScript reader.

The server computes nothing: the page reads a file by byte ranges and makes its tiles in the
browser. Data that need PROJ are computed here and written to terrains.json. The folder of `site`
has samples, and a page that also takes the files of its visitors.
"""

import json
import logging
import os
import re
import shutil
import warnings
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import publish_directory
from terrainwave.errors import CorruptStreamError, InvalidHeightsError, TerrainwaveWarning
from terrainwave.ext.serve.catalog import describe, layer_names
from terrainwave.extras import with_extra
from terrainwave.file import TerrainFile
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.polynomials import FittedPlaces, fit_places
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.render.look.colorings import AUTO, SEA_LEVEL

_log = logging.getLogger(__name__)

LIST = "terrains.json"
_STATIC = Path(__file__).parent / "serve" / "static"
# The reader's folders in js/ of the repository; an installed package has a copy.
_READER = ("src", "map")
_PART = 8 << 20
_END_OF_HEAD, _SELECTION, _DESCRIPTION = "</head>", '<select id="terrain"', '<p id="about"></p>'
# The part of js/ with the site's page, whose file of controls has two parts.
_HEADING = "<summary>terrainwave"
_SITE, _BETWEEN = "site", "<!-- below the description -->"
# Pictures in style sheets are data; visitors may name a file on another server.
_SITE_POLICY = (
    "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self';"
    " style-src 'self'; img-src 'self' data: blob:; connect-src 'self' http: https: data:;"
    " object-src 'none'; base-uri 'none'; form-action 'none'"
)
# Readable with and without red-green blindness.
_SITE_RAMP = "cividis"
_IMPORT = re.compile(r'^(?:import|export)\b[^;"]* from "(\.[^"]+)";', re.MULTILINE)


@dataclass(frozen=True)
class PublishedTerrain:
    """One file of a published folder."""

    name: str  # its name on the page
    file: str  # its name in the folder
    n_bytes: int
    # largest difference of positions in the browser from PROJ's, in samples of the full grid
    # (`fit_places`)
    place_error: float


@with_extra("publish")
def publish_site(
    paths: list[str],
    directory: str | os.PathLike[str],
    *,
    radius: float | None = None,
    encoding: str = tiling.MAPBOX,
    sea_level: str | float = AUTO,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> list[PublishedTerrain]:
    """Write a folder that shows .twz files from any static web server.

    Parameters
    ----------
    paths : list of str
        Paths or URLs of .twz files; they are copied.
    directory : path
        Gets index.html, the page's and the reader's modules, the files and terrains.json; it
        appears complete or not at all.
    radius : float, optional
        Radius in metres of the body that degrees lie on, instead of the CRS's ellipsoid.
    encoding : {"mapbox", "terrarium"}
        Encoding of the page's terrain-RGB tiles; a warning names each file with heights outside its
        range.
    sea_level : {"auto", "none"} or float
        Height in metres below which the page's colours show water, or none; by default 0 if there
        are heights below -450 m.
    overwrite : bool
        Replace an existing folder of this kind.

    Raises
    ------
    InvalidHeightsError
        If browsers cannot read a file's method, the raster has no position on a globe or none that
        polynomials can express, or two files have the same name.
    CorruptStreamError
        If a file is not a .twz file.
    StorageError
        If something cannot be read or written.
    """
    tiling.encoding_of(encoding)
    SEA_LEVEL.checked("sea_level", sea_level)
    return _publish(
        paths, directory, radius=radius, encoding=encoding, sea_level=sea_level,
        overwrite=overwrite, progress=progress,
    )  # fmt: skip


@with_extra("publish")
def write_site(
    directory: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> list[PublishedTerrain]:
    """Write a folder with a page that shows and proves the .twz files of its visitors.

    The folder is that of `publish_site` with three samples. The page opens files that are dropped
    on it or named by a URL, and compares them with their original GeoTIFFs.

    Parameters
    ----------
    directory : path
        As in `publish_site`.
    overwrite : bool
        Replace an existing folder of this kind.

    Returns
    -------
    list of PublishedTerrain
        The samples.

    Raises
    ------
    StorageError
        If something cannot be read or written.
    """
    samples = sorted((reader_directory() / _SITE / "samples").glob("*.twz"))
    paths = [str(path) for path in samples]
    return _publish(paths, directory, is_site=True, overwrite=overwrite, progress=progress)


def _publish(
    paths: list[str],
    directory: str | os.PathLike[str],
    *,
    is_site: bool = False,
    radius: float | None = None,
    encoding: str = tiling.MAPBOX,
    sea_level: str | float = AUTO,
    overwrite: bool,
    progress: ProgressCallback | None,
) -> list[PublishedTerrain]:
    with (
        ExitStack() as opened,
        publish_directory(directory, LIST, overwrite) as new,
        storage_errors(f"cannot write {os.fspath(directory)}"),
    ):
        found = {name: _opened(opened, path, radius) for name, path in layer_names(paths).items()}
        total = sum(globe.terrain.container.source.size for globe, _ in found.values())
        reporter, n_done = Reporter(progress), 0
        _write_page(new, is_site=is_site)
        descriptions, published = [], []
        for name, (globe, places) in found.items():
            if note := tiling.note_on_range(globe, encoding):
                warnings.warn(TerrainwaveWarning(f"{name}: {note}"), stacklevel=3)
            source, file = globe.terrain.container.source, f"{name}.twz"
            with (new / file).open("wb") as copy:
                for start in range(0, source.size, _PART):
                    copy.write(source.read(start, min(_PART, source.size - start)))
                    reporter.report("copying", n_done + start, total)
            n_done += source.size
            placed = places.as_json(globe)
            described = describe(name, globe, encoding, sea_level)
            if is_site:
                described["ramp"] = _SITE_RAMP
            descriptions.append(described | {"file": file, "placed": placed})
            _log.info("%s: %d bytes", file, source.size)
            published.append(PublishedTerrain(name, file, source.size, places.error))
        reporter.report("copying", total, total)
        text = json.dumps(descriptions, allow_nan=False) + "\n"
        (new / LIST).write_text(text, encoding="utf-8")
    return published


def _opened(opened: ExitStack, path: str, radius: float | None) -> tuple[Globe, FittedPlaces]:
    try:
        globe = Globe(opened.enter_context(TerrainFile(path)), radius=radius)
        return globe, fit_places(globe)
    except (InvalidHeightsError, CorruptStreamError) as error:
        raise type(error)(f"{path}: {error}") from error


def _write_page(new: Path, *, is_site: bool) -> None:
    _copy_tree(_STATIC, new / "static")
    (new / "static" / "index.html").unlink()
    reader, copy = reader_directory(), new / "terrainwave"
    for name in (*_READER, _SITE) if is_site else _READER:
        _copy_tree(reader / name, copy / name, ignored=(".d.ts", ".twz", ".md"))
    shutil.copyfile(reader / "LICENSE", copy / "LICENSE")
    text = (_STATIC / "index.html").read_text(encoding="utf-8")
    text = text.replace(_END_OF_HEAD, _early(new, is_site=is_site))
    if is_site:
        above, below = (copy / _SITE / "site.html").read_text(encoding="utf-8").split(_BETWEEN)
        text = text.replace(_SELECTION, above + _SELECTION)
        text = text.replace(_DESCRIPTION, _DESCRIPTION + below)
        text = text.replace(_HEADING, f"{_HEADING}: open or prove a file")  # all that phones show
    (new / "index.html").write_text(text, encoding="utf-8")


def _early(new: Path, *, is_site: bool) -> str:
    """Return the end of the head of a published page, which requests all modules at once."""
    modules = [*_modules(new / "static" / "published.js"), *_modules(new / "static" / "page.js")]
    site = new / "terrainwave" / _SITE
    modules += _modules(site / "site.js") if is_site else []
    of_site = [
        f'<meta http-equiv="Content-Security-Policy" content="{_SITE_POLICY}" />',
        f'<link rel="stylesheet" href="terrainwave/{_SITE}/site.css" />',
        f'<script type="module" src="terrainwave/{_SITE}/site.js"></script>',
    ]
    lines = [
        *(of_site if is_site else []),
        f'<link rel="preload" as="fetch" crossorigin href="{LIST}" />',
        *(
            f'<link rel="modulepreload" href="{module.relative_to(new).as_posix()}" />'
            for module in dict.fromkeys(modules)
        ),
        '<script type="module" src="static/published.js"></script>',
    ]
    return "".join(f"  {line}\n  " for line in lines) + _END_OF_HEAD


def _modules(module: Path) -> list[Path]:
    found = [module]
    for name in _IMPORT.findall(module.read_text(encoding="utf-8")):
        found += _modules((module.parent / name).resolve())
    return found


def _copy_tree(source: Path, target: Path, ignored: tuple[str, ...] = ()) -> None:
    """Copy a folder, with the modes of new files: the package's may be read-only."""
    target.mkdir(parents=True)
    for path in sorted(source.iterdir()):
        if path.is_dir():
            _copy_tree(path, target / path.name, ignored)
        elif not path.name.endswith(ignored):
            shutil.copyfile(path, target / path.name)


def reader_directory() -> Path:
    """Return the folder of the JavaScript reader: in the package, or in its repository."""
    here = Path(__file__)
    for found in (here.parent / "serve" / "reader", here.parents[3] / "js"):
        if (found / "src" / "index.js").is_file():
            return found
    raise InvalidHeightsError("the reader in JavaScript is not installed with this package")
