"""What people type by mistake: one line that says what was found, what was expected, what to do."""

import shutil

import pytest
from affine import Affine
from commands import one_line, run
from strategies import terrain_like, write_geotiff

import terrainwave

PLACE = {"crs": "EPSG:32633", "transform": Affine(30.0, 0, 500_000.0, 0, -30.0, 5_000_000.0)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A raster, files of it, and what is none; no test changes it."""
    folder = tmp_path_factory.mktemp("files")
    dem = write_geotiff(folder / "a.tif", terrain_like(60, 70), units=("m",), **PLACE)
    terrainwave.compress(dem, folder / "a.twz", block=32)
    terrainwave.compress(dem, folder / "bare.twz", block=32, mesh="none", method="store")
    data = (folder / "a.twz").read_bytes()
    (folder / "cut.twz").write_bytes(data[: len(data) // 2])
    middle = len(data) // 2
    changed = bytes([data[middle] ^ 255])
    (folder / "bad.twz").write_bytes(data[:middle] + changed + data[middle + 1 :])
    for name in ("empty.tif", "empty.twz"):
        (folder / name).touch()
    (folder / "text.twz").write_text("hello")
    (folder / "page.twz").write_text("\n<!doctype HTML><title>404</title>")
    shutil.copy(dem, folder / "raster.twz")
    (folder / "flight.json").write_text("x, y")
    (folder / "sub").mkdir()
    (folder / "full").mkdir()
    (folder / "full" / "x").touch()
    return folder


# What is typed, the status, and what the line has.
MISTAKES = [
    # Files that are not what is meant.
    ("compress sub new.twz", 1, "sub is a directory; expected a raster file"),
    ("compress empty.tif new.twz", 1, "empty.tif is empty; expected a raster file"),
    ("verify a.twz sub", 1, "sub is a directory; expected a raster file"),
    ("verify a.twz empty.tif", 1, "empty.tif is empty; expected a raster file"),
    ("info sub", 1, "sub is a directory; expected a .twz file"),
    ("info empty.twz", 1, "empty.twz: found an empty file, expected a .twz file"),
    ("info text.twz", 1, "text.twz: found another kind of file, expected a .twz file"),
    ("info page.twz", 1, "page.twz: found a web page, expected a .twz file"),
    ("info raster.twz", 1, "found a TIFF, expected a .twz file; terrainwave compress makes one"),
    ("serve raster.twz", 1, "raster.twz: found a TIFF, expected a .twz file"),
    ("publish raster.twz site", 1, "raster.twz: found a TIFF, expected a .twz file"),
    ("patch a.tif bare.twz", 1, "a.tif: found a TIFF, expected a .twz file"),
    ("info cut.twz", 1, "the file is damaged: copy or download it again"),
    ("decompress bad.twz new.tif", 1, "the file is damaged: copy or download it again"),
    ("verify a.twz bare.twz a.tif", 2, "found 3 names that are not all .twz, expected FILE and"),
    # Names of targets and of URLs.
    ("compress a.tif new.TWZ2", 2, "found .TWZ2, expected a name that ends in .twz"),
    ("compress a.tif http://a/b.twz", 2, "expected a path, or the URL of storage that takes files"),
    ("decompress a.twz http://a/b.tif", 2, "a path: files are written only to this machine"),
    ("decompress a.twz new.jpg", 2, "Invalid value for TARGET: new.jpg: found .jpg, expected a"),
    ("mesh a.twz new.foo", 2, ".vtk or .terrain, or in .twz with --store"),
    ("mesh a.twz new.foo --store", 2, "found .foo, expected a name that ends in .twz"),
    ("info htp://a/b.twz", 1, "expected a path, or a URL of https or of another protocol"),
    ("info zip://a.twz", 1, "found no archive, expected zip://FILE::ARCHIVE"),
    ("info https://", 1, "found no host, expected a URL such as https://"),
    ("info http://127.0.0.1:9/a.twz", 1, "http://127.0.0.1:9/a.twz: Connection refused"),
    ("publish a.twz", 2, "DIRECTORY': a.twz: found a file (.twz), expected a directory"),
    ("publish site", 2, "found site alone, expected FILES and DIRECTORY"),
    ("serve a.twz --host a.invalid", 1, "expected an address of this machine, such as"),
    # Values, and parts of the raster.
    ("compress a.tif new.twz --band 2", 2, "found --band 2, expected 1: a.tif has 1 band"),
    ("verify a.twz a.tif --band 3", 2, "found --band 3, expected 1: a.tif has 1 band"),
    ("decompress a.twz new.tif --window 0,0,0,9", 2, "found a --window of 0 x 9 samples"),
    ("decompress a.twz new.tif --window 99,0,1,9", 2, "lies outside the level, which has"),
    ("tiles a.twz new --encoding mapbox", 2, "found --encoding for a directory, expected none"),
    ("mesh a.twz new.ply --mesh rqt", 2, "found --mesh without --store, expected --store with it"),
    ("mesh a.twz new.twz --store --solid 3", 2, "with --store, expected none of them"),
    # Options that would change nothing.
    ("verify a.twz --band 1", 2, "found --band without ORIGINAL, expected both"),
    ("verify a.twz --nodata 3", 2, "found --nodata without ORIGINAL, expected both"),
    ("verify a.twz bare.twz --max-error 3", 2, "found --max-error without ORIGINAL"),
    ("render a.twz new.png --frames 3", 2, "found --frames without --flight, expected both"),
    (
        "render a.twz new.png --flight flight.json --bounds 0,0,1,1",
        2,
        "found --flight and --bounds, expected one of them",
    ),
]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "status", "message"), MISTAKES, ids=lambda value: str(value)[:40]
)
def test_a_mistake_is_one_line_that_says_what_to_do(folder, monkeypatch, words, status, message):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    assert message in one_line(run(*words.split()), status)
    assert sorted(folder.rglob("*")) == before
