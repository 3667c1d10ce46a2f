"""What commands and functions agree to write, and what they never replace."""

import io
import os
import shutil
import sys

import numpy as np
import pytest
from commands import one_line, run, start
from rasterio.transform import Affine
from strategies import read_geotiff, terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import StorageError

QUICK = ["--method", "store", "--block", 32, "--no-mesh", "--max-error", 1]
OPTIONS = {"method": "store", "block": 32, "mesh": "none", "max_error": 1}


@pytest.fixture
def dems(tmp_path):
    """Return three rasters of one grid, side by side."""
    paths = []
    for number in range(3):
        paths.append(tmp_path / f"{'abc'[number]}.tif")
        transform = Affine(30, 0, 4e5 + number * 600, 0, -30, 4e6)
        write_geotiff(paths[-1], terrain_like(20, 20), crs="EPSG:32611", transform=transform)
    return paths


@pytest.fixture
def twz(tmp_path):
    path = tmp_path / "dem.twz"
    terrainwave.compress(terrain_like(20, 20), path, **OPTIONS)
    return path


def contents(directory):
    return {path.name: path.read_bytes() for path in directory.iterdir()}


@pytest.mark.parametrize(
    "arguments",
    [
        ["compress", "", "a.twz"], ["compress", "a.tif", ""], ["compress", "a.tif", "", "a.twz"],
        ["compress", "", "--to", "out"], ["compress", "a.tif", "--to", ""],
        ["compress", "a.tif", "new.twz", "--temp-dir", ""],
        ["decompress", "", "a.tif"], ["decompress", "dem.twz", ""],
        ["decompress", "", "--to", "out"],
        ["patch", "", "a.tif"], ["patch", "dem.twz", ""],
        ["patch", "dem.twz", "a.tif", "--original", ""],
        ["patch", "dem.twz", "a.tif", "--temp-dir", ""],
        ["info", ""], ["verify", ""], ["verify", "dem.twz", ""],
        ["mesh", "", "a.ply"], ["mesh", "dem.twz", ""], ["mesh", "dem.twz", "", "--store"],
        ["mesh", "dem.twz", "b.twz", "--store", "--original", ""],
        ["tiles", "", "out"], ["tiles", "dem.twz", ""], ["publish", "", "out"],
        ["publish", "dem.twz", ""], ["render", "", "a.png"], ["render", "dem.twz", ""],
        ["site", ""], ["warmup", "--to", ""], ["demo", ""],
    ],
    ids=" ".join,
)  # fmt: skip
def test_an_empty_name_is_one_clear_line(tmp_path, dems, twz, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    before = contents(tmp_path)
    line = one_line(run(*arguments), 2)
    assert "found '', an empty name, expected that of a " in line
    assert contents(tmp_path) == before


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
@pytest.mark.parametrize("n_sources", [2, 3])
def test_the_last_of_several_rasters_is_never_the_target(tmp_path, dems, overwrite, n_sources):
    before = contents(tmp_path)
    line = one_line(run("compress", *dems[:n_sources], *QUICK, *overwrite), 2)
    assert f"{dems[n_sources - 1]}: found .tif, expected a name that ends in .twz" in line
    assert "--to DIR" in line
    assert "overwrite" not in line
    assert contents(tmp_path) == before


@pytest.mark.parametrize("by_link", [False, True])
def test_a_raster_with_the_name_of_a_twz_is_never_the_target(tmp_path, dems, by_link):
    target = tmp_path / "old.twz"
    if by_link:
        target.symlink_to(dems[1])
    else:
        shutil.copy(dems[1], target)
    before = contents(tmp_path)
    for overwrite in ([], ["--overwrite"]):
        line = one_line(run("compress", dems[0], target, *QUICK, *overwrite), 1)
        assert "is a raster and is never replaced" in line
        assert "overwrite" not in line
    with pytest.raises(StorageError, match="never replaced"):
        terrainwave.compress(dems[0], target, overwrite=True, **OPTIONS)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("command", "target"),
    [
        *(("decompress", name) for name in ("b.jpg", "b.vrt", "b.asc", "b", "b.twz")),
        *(("render", name) for name in ("x.jpg", "x", "x.tif")),
        *(("mesh", name) for name in ("m.fbx", "m", "-", "m.twz")),
        *(("mesh --store", name) for name in ("m.ply", "m.tif", "-")),
        *(("tiles", name) for name in ("-", "t.mbtiles", "t.zip")),
    ],
)
def test_a_command_refuses_what_it_does_not_write(tmp_path, monkeypatch, twz, command, target):
    monkeypatch.chdir(tmp_path)
    before = contents(tmp_path)
    name, *options = command.split()
    line = one_line(run(name, twz, target, *options), 2)
    assert f"{target}: found" in line
    assert "expected a" in line
    assert contents(tmp_path) == before


def pipe(data, *args):
    """Run a command in a process of its own with `data` on stdin; return what it wrote."""
    process = start(*args, stdin=-1)
    stdout, stderr = (stream.buffer for stream in (process.stdout, process.stderr))
    process.stdin.buffer.write(data)
    process.stdin.close()
    found = stdout.read(), stderr.read().decode()
    stdout.close()
    stderr.close()
    return process.wait(300), *found


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of text")
def test_compress_and_decompress_go_through_pipes(tmp_path, dems):
    status, data, said = pipe(dems[0].read_bytes(), "compress", "-", "-", *QUICK)
    assert status == 0, said
    assert "-: " in said
    assert "bits/sample" in said
    with terrainwave.open(io.BytesIO(data)) as terrain:
        assert terrain.shape == (20, 20)
    status, tiff, said = pipe(data, "decompress", "-", "-")
    assert status == 0, said
    (tmp_path / "back.tif").write_bytes(tiff)
    heights, _, profile = read_geotiff(tmp_path / "back.tif")
    assert np.abs(heights.astype(int) - read_geotiff(dems[0])[0]).max() <= 1
    assert profile["crs"] == "EPSG:32611"
    status, said, _ = pipe(data, "verify", "-", dems[0])
    assert (status, said.splitlines()[-1]) == (0, b"ok")
    assert sorted(os.listdir(tmp_path)) == ["a.tif", "b.tif", "back.tif", "c.tif"]


@pytest.mark.full
def test_nothing_goes_to_stdout_if_it_fails(tmp_path):
    status, data, said = pipe(b"no raster", "compress", "-", "-", *QUICK)
    assert (status, data) == (1, b"")
    assert "not a raster" in said


def test_stdin_is_read_once(tmp_path, dems):
    line = one_line(run("compress", "-", "-", tmp_path / "a.twz", *QUICK), 2)
    assert "found - twice" in line


@pytest.mark.parametrize("args", [["serve", "-"], ["patch", "-", "b.tif"]])
def test_commands_that_need_a_name_refuse_a_stream(args):
    assert "expected a file name" in one_line(run(*args), 2)
