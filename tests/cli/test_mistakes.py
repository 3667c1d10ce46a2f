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
    (folder / "notes.txt").write_text("hello")
    (folder / "sub").mkdir()
    return folder


MADE = "compress a.tif new.twz"
MESH = "mesh a.twz new.ply"
STORED = "mesh a.twz new.twz --store"
TILE = "decompress a.twz new.r16"
BACK = "decompress a.twz new.tif"
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
    *((f"{words} nowhere", 1, "nowhere") for words in ("info", "verify", "verify a.twz")),
    *((f"{words} nowhere new.twz", 1, "nowhere") for words in ("compress", "patch")),
    ("decompress nowhere new.tif", 1, "nowhere"),
    ("decompress sub new.tif", 1, "sub is a directory"),
    ("patch a.twz bare.twz", 1, "already a terrainwave file"),
    ("compress notes.txt new.twz", 1, "not a raster"),
    ("compress a.tif no/such/a.twz", 1, "no directory"),
    ("decompress a.twz no/such/a.tif", 1, "no directory"),
    # Names of targets and of URLs.
    *((f"info http://{bad}", 1, "is not a URL") for bad in ("[bad/x", "host:port/x", "h:99999/x")),
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
    (f"{MADE} --band 2", 2, "found --band 2, expected 1: a.tif has 1 band"),
    *((f"{MADE} --max-error {bound}", 2, f"'--max-error': found {bound}, expected a finite")
      for bound in ("-1", "nan", "inf", "one", "1m")),
    *((f"{MADE} --block {side}", 2, "expected one of 32, 64") for side in (100, 16)),
    (f"{MADE} --method zip", 2, "'auto'"),
    (f"{MADE} --effort huge", 2, "'best'"),
    (f"{MADE} -o border_rings=2", 2, "expected --method predictive, cdf97 or store"),
    (f"{MADE} --nodata some", 2, "expected a number, or nan, only:NUMBER or none"),
    (f"{MADE} --nodata {'9' * 400}", 2, "outside int16"),
    (f"{MADE} --band 0", 2, "x>=1"),
    (f"{MADE} --threads 0", 2, "x>=1"),
    (f"{MADE} --mesh rtin", 2, "'halves'"),
    (f"{MADE} --mesh-error -1", 2, "expected a finite number >= 0"),
    (f"{MADE} --colour red", 2, "No such option"),
    (f"{MADE} --method cdf53 -o rate=1 -o psnr=40", 2, "found -o rate=1 and -o psnr=40"),
    (f"{MADE} --method cdf53 -o rate=1 --max-error 2", 2, "found --max-error and -o rate"),
    (f"{MADE} -o psnr=40", 2, "found -o psnr=40 and no --method, expected --method cdf53"),
    (f"{MADE} --method cdf53 -o rate=0", 2, "found -o rate=0, expected a finite number > 0"),
    (f"{MADE} --method cdf53 --scheduler x", 2, "found --scheduler and --method cdf53"),
    (f"{BACK} --window 0,0,1,1 --bounds 0,0,1,1", 2, "expected one of them"),
    *((f"{BACK} {words}", 2, "expected four")
      for words in ("--window 1,2,3", "--window 1,2,3,4.5", "--bounds 1,2,3,nan")),
    (f"{BACK} --level 99", 2, "expected 0 (coarsest) to 2, or -1 (full grid) to -3"),
    (f"{BACK} --bounds 1e6,1e6,2e6,2e6", 2, "lie outside the raster's, 500000, 4998200, 502100,"),
    (f"{BACK} --size 65", 2, "--size is for height tiles"),
    *((f"{BACK} --voids {value}", 2, f"--voids {value} is for height tiles")
      for value in ("fill", "-9999")),
    (f"{BACK} --voids up", 2, "found --voids up, expected exact or any, or a name ending in"),
    (f"{TILE} --voids up", 2, "found --voids 'up', expected lowest, fill or a height"),
    *((f"{TILE} --size {size}", 2, f"found {size}, expected 2^n + 1") for size in ("1024", "big")),
    ("decompress a.twz new.png --cog", 2, "cannot be a COG"),
    *((f"{MESH} {option} {value}", 2, f"found {value}, expected a finite number{above}")
      for option, value, above in (
          ("--z-scale", -1, " > 0"), ("--z-scale", 0, " > 0"), ("--radius", "moon", " > 0"),
          ("--solid", "deep", ""), ("--max-error", -1, " >= 0"), ("--skirts", 0, " > 0"))),
    (f"{MESH} --max-triangles 0", 2, "0 is not in the range"),
    (f"{MESH} --frame world", 2, "'local', 'native', 'ecef'"),
    (f"{MESH} --window 1,2,3", 2, "four whole numbers"),
    (f"{MESH} --window 0,0,5,5 --bounds 1,2,3,4", 2, "both --window and --bounds"),
    (f"{MESH} --lods 2 --max-triangles 9", 2, "found --max-triangles with --lods, expected none"),
    (f"{MESH} --lods 2 --level -2", 2, "found --level with --lods, expected none"),
    (f"{MESH} --lods 2 --loose", 2, "found --loose with --lods, expected none"),
    (f"{MESH} --lods 2 --max-error 0", 2, "found --max-error 0 for several levels of detail"),
    (f"{MESH} --lods 0", 2, "0 is not in the range 1<=x<=16"),
    ("mesh a.twz new.glb --up z", 2, "found --up z for .glb, expected y or none"),
    (f"{MESH} --skirts 3 --solid -9", 2, "found --solid and --skirts, expected one of them"),
    (f"{STORED} --lods 2", 2, "found --lods with --store"),
    (f"{STORED} --frame local --solid 3", 2, "found --frame, --solid with --store"),
    (f"{STORED} --mesh none", 2, "'none' is not one of 'halves', 'zerotree', 'rqt'"),
    (f"{STORED} --mesh rqt3", 2, "rqt3"),
    (f"{STORED} --mesh zerotree -o labels=coded", 2, "that codes no zero trees"),
    (f"{STORED} -o labels=coded", 2, "found -o labels=coded and no --mesh, expected --mesh"),
    (f"{STORED} --mesh rqt -o rate=1", 2, "found -o rate=1, expected -o select (see"),
    (f"{STORED} --drape a.png", 2, "found --drape with --store, expected none of them"),
    (f"{MESH} --mesh-error 2", 2, "found --mesh-error without --store"),
    (f"{MESH} -o labels=coded", 2, "found -o without --store"),
    # Several files.
    ("compress x/a.tif y/A.tif --to out", 2, "would both be"),
    ("compress - --to out", 2, "found - and --to"),
    ("compress --to out", 2, "Missing argument 'SOURCE'"),
    ("compress a.tif --to out --scheduler x", 2, "found --scheduler and --to"),
    ("compress a.tif --to -", 2, "expected a directory"),
    (f"{MADE} --skip-existing", 2, "found --skip-existing without --to"),
    ("compress a.tif a.tif new.twz --no-georeference", 2, "and 2 SOURCEs, expected one"),
    ("decompress a.twz --to out --skip-existing --overwrite", 2, "--skip-existing and --overwrite"),
    ("decompress a.twz b.twz c.twz", 2, "add --to DIR"),
    ("decompress a.twz", 2, "Missing argument 'TARGET'"),
    ("verify a.twz bare.twz a.tif", 2, "found 3 names that are not all .twz, expected FILE and"),
    ("verify", 2, "Missing argument 'FILE'"),
    ("verify a.twz --part", 2, "found --part without ORIGINAL"),
    ("verify a.twz a.tif --part --mesh", 2, "--part and --mesh"),
    ("verify a.twz a.tif --band 3", 2, "found --band 3, expected 1: a.tif has 1 band"),
    ("decompress a.twz new.tif --window 0,0,0,9", 2, "found a --window of 0 x 9 samples"),
    ("decompress a.twz new.tif --window 99,0,1,9", 2, "lies outside the level, which has"),
    ("tiles a.twz new --encoding mapbox", 2, "found --encoding for a directory, expected none"),
    (f"{MESH} --mesh rqt", 2, "found --mesh without --store, expected --store with it"),
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
    line = one_line(run(*words.split()), status)
    assert message in line
    assert len(line) < 500
    assert sorted(folder.rglob("*")) == before
