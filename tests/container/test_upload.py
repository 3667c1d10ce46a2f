"""Targets by URL: complete or not at all."""

from unittest.mock import Mock

import pytest
from click.testing import CliRunner
from fsspec.implementations.memory import MemoryFileSystem
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.cli import main
from terrainwave.errors import InvalidArgumentError, StorageError

OPTIONS = {"method": "store", "mesh": "none", "block": 32, "max_error": 1}


@pytest.fixture
def raster(tmp_path):
    return write_geotiff(tmp_path / "dem.tif", terrain_like(40, 50))


def names(files):
    return sorted(files.find("/"))


def test_a_file_is_uploaded_whole(tmp_path, raster, memory):
    result = terrainwave.compress(raster, "memory://bucket/dem.twz", temp_dir=tmp_path, **OPTIONS)
    terrainwave.compress(raster, tmp_path / "dem.twz", **OPTIONS)
    assert result.path == "memory://bucket/dem.twz"
    assert memory.cat("/bucket/dem.twz") == (tmp_path / "dem.twz").read_bytes()
    assert result.n_bytes == memory.size("/bucket/dem.twz")
    assert names(memory) == ["/bucket/dem.twz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dem.tif", "dem.twz"]
    with terrainwave.open("memory://bucket/dem.twz") as terrain:
        assert terrain.shape == (40, 50)


def test_what_is_there_is_replaced_only_if_asked(raster, memory):
    memory.pipe("/bucket/dem.twz", b"other")
    with pytest.raises(StorageError, match="already exists and is left as it is"):
        terrainwave.compress(raster, "memory://bucket/dem.twz", **OPTIONS)
    assert memory.cat("/bucket/dem.twz") == b"other"
    terrainwave.compress(raster, "memory://bucket/dem.twz", overwrite=True, **OPTIONS)
    assert memory.cat("/bucket/dem.twz") != b"other"


def test_what_gdal_kept_of_the_file_before_goes(raster, memory):
    for name in ("dem.twz", "dem.twz.aux.xml", "dem.twz.ovr", "other.twz.aux.xml"):
        memory.pipe(f"/bucket/{name}", b"other")
    terrainwave.compress(raster, "memory://bucket/dem.twz", overwrite=True, **OPTIONS)
    assert names(memory) == ["/bucket/dem.twz", "/bucket/other.twz.aux.xml"]


def test_storage_that_forbids_to_look_for_other_files_takes_the_file(raster, memory, monkeypatch):
    exists = MemoryFileSystem.exists

    def forbid(self, path, **options):
        if not path.endswith((".twz", ".twz-part")):
            raise PermissionError(path)
        return exists(self, path, **options)

    monkeypatch.setattr(MemoryFileSystem, "exists", forbid)
    memory.pipe("/bucket/dem.twz.aux.xml", b"other")
    terrainwave.compress(raster, "memory://bucket/dem.twz", overwrite=True, **OPTIONS)
    assert names(memory) == ["/bucket/dem.twz", "/bucket/dem.twz.aux.xml"]


@pytest.mark.parametrize("failing", ["put_file", "mv"])
def test_a_failed_upload_leaves_the_target_and_keeps_the_work(
    tmp_path, raster, memory, monkeypatch, failing
):
    memory.pipe("/bucket/dem.twz", b"other")

    monkeypatch.setattr(
        MemoryFileSystem, failing, Mock(side_effect=ConnectionError("the line is down"))
    )
    with pytest.raises(StorageError, match=r"the line is down; the finished file is (.*): upload"):
        terrainwave.compress(
            raster, "memory://bucket/dem.twz", temp_dir=tmp_path, overwrite=True, **OPTIONS
        )
    assert memory.cat("/bucket/dem.twz") == b"other"
    assert names(memory) == ["/bucket/dem.twz"]
    (kept,) = tmp_path.glob("dem-*.twz")
    assert terrainwave.verify(kept, raster).ok


def test_a_file_that_arrives_short_is_no_success(tmp_path, raster, memory, monkeypatch):
    monkeypatch.setattr(MemoryFileSystem, "size", lambda self, path: 3)
    with pytest.raises(StorageError, match="found 3 bytes there, expected"):
        terrainwave.compress(raster, "memory://bucket/dem.twz", temp_dir=tmp_path, **OPTIONS)


def test_a_file_that_fails_is_not_uploaded(raster, memory):
    with pytest.raises(InvalidArgumentError):
        terrainwave.compress(raster, "memory://bucket/dem.twz", **OPTIONS | {"block": 33})
    assert names(memory) == []


@pytest.mark.parametrize(
    "url", ["https://me:secret@example.org/a.twz", "zip://a.twz::memory://b.zip"]
)
def test_what_takes_no_files_is_refused(raster, url):
    done = CliRunner().invoke(main, ["compress", str(raster), url, "--no-mesh"])
    assert done.exit_code == 2
    assert "expected a path, or the URL of storage that takes files" in done.stderr
    assert "secret" not in done.stderr


def test_the_command_prints_the_url_without_its_login(raster, memory):
    url = "memory://bucket/a.twz"
    done = CliRunner().invoke(main, ["compress", str(raster), url, "--max-error", "1"])
    assert done.exit_code == 0, done.stderr
    assert done.stdout.startswith(f"{url}: ")
    again = CliRunner().invoke(main, ["compress", url, url, "--overwrite"])
    assert "is the file to be read" in again.stderr


def test_a_cluster_needs_a_path(raster):
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as executor, pytest.raises(InvalidArgumentError, match="a client"):
        terrainwave.compress(raster, "memory://a/b.twz", client=executor, **OPTIONS)
