"""Capsules are read with what they hold and a C compiler."""

import hashlib
import shutil
import subprocess
import zipfile

import numpy as np
import pytest
import rasterio

import terrainwave
from terrainwave.capsule import decoder_sources, write_capsule
from terrainwave.errors import CorruptStreamError, StorageError

HEIGHTS = np.add.outer(np.arange(300) ** 2 % 611, np.arange(280) % 97).astype(np.int16)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("capsule") / "dem.twz"
    heights = HEIGHTS.copy()
    heights[40:90, 100:170] = -32768
    described = {"crs": "EPSG:32632", "transform": (30, 0, 4e5, 0, -30, 5e6), "nodata": -32768}
    with rasterio.open(
        path.with_suffix(".tif"), "w", driver="GTiff", height=300, width=280, count=1,
        dtype="int16", **described,
    ) as raster:  # fmt: skip
        raster.write(heights, 1)
        raster.units = ["m"]
    terrainwave.compress(path.with_suffix(".tif"), path, max_error=2)
    return path


@pytest.fixture(scope="module")
def unpacked(file):
    archive = file.with_name("dem-archive.zip")
    write_capsule(file, archive)
    with zipfile.ZipFile(archive) as capsule:
        capsule.extractall(file.parent)
    return file.parent / "dem-archive"


@pytest.fixture(scope="module")
def twz(unpacked):
    if shutil.which("cc") is None:
        pytest.skip("this machine has no C compiler")
    sources = [str(unpacked / "decoder" / name) for name in ("terrainwave.c", "twz.c")]
    command = [
        "cc",
        "-std=c11",
        "-Wall",
        "-Wextra",
        "-Wpedantic",
        *sources,
        "-o",
        str(unpacked / "twz"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, "warning: " in done.stderr) == (0, False), done.stderr
    return str(unpacked / "twz")


def told(*command):
    return subprocess.run(command, capture_output=True, check=True).stdout


def test_all_files_have_their_checksums(unpacked):
    sums = dict(
        reversed(line.split("  ")) for line in (unpacked / "SHA256SUMS").read_text().splitlines()
    )
    found = {
        path.relative_to(unpacked).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in unpacked.rglob("*")
        if path.is_file() and path.name not in ("SHA256SUMS", "twz")
    }
    assert found == sums
    assert {"dem.twz", "README.txt", "LICENSE", "format/annexes/rapid.bin"} <= set(found)


def test_the_decoder_of_a_capsule_reads_its_heights(twz, unpacked, file):
    path = str(unpacked / "dem.twz")
    with terrainwave.open(file) as terrain:
        heights, valid = terrain.read_with_mask()
        root = terrain.digest()
    dumped = np.frombuffer(told(twz, "dump", path), np.int16).reshape(HEIGHTS.shape)
    mask = np.frombuffer(told(twz, "dump", path, "--mask"), np.uint8).reshape(HEIGHTS.shape)
    np.testing.assert_array_equal(mask, valid)
    np.testing.assert_array_equal(dumped[valid], heights[valid])
    assert told(twz, "root", path).decode().strip() == root
    assert told(twz, "check", path) == b""


def test_the_readme_says_what_an_archivist_has_to_know(unpacked, file):
    text = (unpacked / "README.txt").read_text()
    with terrainwave.open(file) as terrain:
        assert terrain.digest() in text
    for words in ("within 2 m of the original", "300 rows x 280 columns", "EPSG:32632"):
        assert words in text
    assert not [line for line in text.splitlines() if len(line) > 100]


def test_equal_capsules_have_equal_bytes(file, tmp_path):
    written = [write_capsule(file, tmp_path / name / "a.zip") for name in _folders(tmp_path)]
    first, second = ((tmp_path / name / "a.zip").read_bytes() for name in ("one", "two"))
    assert first == second
    assert written[0].n_bytes == len(first)


def _folders(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        yield name


def test_a_damaged_file_gets_no_capsule(file, tmp_path):
    data = bytearray(file.read_bytes())
    data[-200] ^= 1
    (tmp_path / "bad.twz").write_bytes(data)
    with pytest.raises(CorruptStreamError, match="would archive the damage"):
        write_capsule(tmp_path / "bad.twz", tmp_path / "bad.zip")
    assert not (tmp_path / "bad.zip").exists()


def test_an_existing_capsule_is_replaced_only_on_request(file, tmp_path):
    write_capsule(file, tmp_path / "a.zip")
    with pytest.raises(StorageError):
        write_capsule(file, tmp_path / "a.zip")
    write_capsule(file, tmp_path / "a.zip", overwrite=True)


def test_a_file_without_digests_has_no_root_in_its_capsule(tmp_path):
    terrainwave.compress(HEIGHTS, tmp_path / "a.twz", max_error=0, digest=False)
    written = write_capsule(tmp_path / "a.twz", tmp_path / "a.zip")
    assert written.root is None
    with zipfile.ZipFile(tmp_path / "a.zip") as capsule:
        assert "the file has no digests" in capsule.read("a/README.txt").decode()


def test_the_amalgamation_includes_nothing_but_its_header():
    source = decoder_sources()["terrainwave.c"]
    includes = [line for line in source.splitlines() if line.startswith('#include "')]
    assert includes == ['#include "terrainwave.h"']
