"""A run that was killed, or failed, is gone on with by the same command: same bytes, less work."""

import os
import signal
import subprocess
import sys
import traceback
import warnings
from unittest.mock import Mock

import numpy as np
import pytest
import rasterio.shutil
from cases import some
from click.testing import CliRunner
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.cli import main
from terrainwave.container.targets import kept as kept_module
from terrainwave.container.targets.kept import Kept
from terrainwave.errors import InvalidHeightsError, StorageError, TerrainwaveWarning
from terrainwave.raster_io import source as source_module
from terrainwave.raster_io import temporary
from terrainwave.raster_io.source import RasterSource
from terrainwave.write.encoder import TreeEncoder
from terrainwave.write.passes import resuming
from terrainwave.write.passes import seen as seen_module
from terrainwave.write.passes import windows as windows_module
from terrainwave.write.patch import patch

NODATA = -32768
OPTIONS = {"block": 32, "max_error": 1, "threads": 2}
SHAPE = 700, 600


def heights_with_voids():
    heights = terrain_like(*SHAPE, seed=3)
    heights[100:420, 50:300] = NODATA
    return heights


@pytest.fixture(autouse=True)
def small_runs_are_long(monkeypatch):
    """Everything is kept, at once, of small rasters too; arrays lie in files."""
    monkeypatch.setattr(resuming, "LEAST_SAMPLES", 1)
    monkeypatch.setattr(resuming, "SUBTREE_SIDE", 128)
    monkeypatch.setattr(kept_module, "TICK", 0.0)
    monkeypatch.setattr(temporary, "MEMORY_LIMIT", 1 << 14)
    monkeypatch.setattr(windows_module, "MEMORY_LIMIT", 1 << 14)
    monkeypatch.setattr(source_module, "_NARROW_COLS", 100)
    monkeypatch.setattr(seen_module, "SIDE", 64)


@pytest.fixture
def raster(tmp_path):
    striped = write_geotiff(tmp_path / "striped.tif", heights_with_voids(), nodata=NODATA)
    tiled = tmp_path / "dem.tif"
    rasterio.shutil.copy(striped, tiled, tiled=True, blockxsize=64, blockysize=64, driver="GTiff")
    return tiled


def mostly_even(folder, name, nodata, *, is_sparse):
    """Write a raster that is mostly void, or 0 without `nodata`, whose blocks may have no bytes."""
    heights = np.full((1300, 1100), nodata or 0, dtype=np.int16)
    heights[520:900, 300:650] = terrain_like(380, 350, seed=4)
    path = folder / name
    with rasterio.open(
        path, "w", driver="GTiff", width=1100, height=1300, count=1, dtype="int16", nodata=nodata,
        tiled=True, blockxsize=64, blockysize=64, SPARSE_OK=is_sparse, crs="EPSG:32633",
        transform=rasterio.Affine(30, 0, 5e5, 0, -30, 5e6),
    ) as dataset:  # fmt: skip
        dataset.write(heights, 1)
    return path


@pytest.fixture
def source_of(tmp_path, raster):
    def source(name):
        if name.startswith(("sparse", "full")):
            nodata = None if name.endswith("of 0.tif") else NODATA
            return mostly_even(tmp_path, name, nodata, is_sparse=name.startswith("sparse"))
        return tmp_path / name

    return source


def killed_at(record, work):
    """Run `work` in a fork that is killed once `record` records were kept; say whether it was."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
        child = os.fork()
    if child == 0:
        signal.alarm(60)
        put, count = Kept.put, 0

        def counting(self, *arguments):
            nonlocal count
            put(self, *arguments)
            count += 1
            if count == record:
                os.kill(os.getpid(), signal.SIGKILL)

        Kept.put = counting
        status = 1
        try:
            work()
            status = 0
        except BaseException:  # noqa: BLE001  the child ends here
            traceback.print_exc(file=sys.__stderr__)
        finally:
            os._exit(status)
    status = os.waitpid(child, 0)[1]
    assert status in (0, signal.SIGKILL)
    return status != 0


def hidden_in(folder):
    return sorted(name for name in os.listdir(folder) if name.startswith("."))


def n_records(work, monkeypatch):
    """Return how many records a run keeps."""
    names = []
    put = Kept.put

    def noting(self, name, *rest):
        names.append(name)
        put(self, name, *rest)

    with monkeypatch.context() as patched:
        patched.setattr(Kept, "put", noting)
        work()
    return len(names)


@pytest.mark.few(1)
@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forks")
@pytest.mark.parametrize(
    ("method", "name", "mesh"),
    some(
        [
            ("rapid", "dem.tif", "halves"),
            ("rapid", "sparse.tif", "halves"),
            ("predictive", "striped.tif", "zerotree"),
            ("rapid", "full of 0.tif", "none"),
            ("cdf97", "full.tif", "none"),
            ("cdf53", "dem.tif", "none"),
        ],
        4,
    ),
)
def test_a_run_goes_on_after_kills_at_any_moment(
    tmp_path, source_of, monkeypatch, method, name, mesh
):
    source = source_of(name)
    target = tmp_path / "out.twz"

    def work():
        terrainwave.compress(source, target, method=method, mesh=mesh, overwrite=True, **OPTIONS)

    total = n_records(work, monkeypatch)
    whole = target.read_bytes()
    assert total > 10
    target.unlink()
    for part in (1, total // 4):  # from where the last one was killed
        assert killed_at(part, work)
        assert not target.exists()
        assert any(name.endswith(".twz-kept") for name in hidden_in(tmp_path))
    left = n_records(work, monkeypatch)
    assert target.read_bytes() == whole
    assert left < total * 0.8
    assert hidden_in(tmp_path) == []


def test_what_is_finished_is_not_done_again(tmp_path, raster, monkeypatch):
    target = tmp_path / "out.twz"
    units, reads = [], []
    encode, read = TreeEncoder._encode_unit, RasterSource.read

    def noting(self, start):
        units.append(start.key)
        return encode(self, start)

    def reading(self, *window):
        reads.append(window)
        return read(self, *window)

    monkeypatch.setattr(TreeEncoder, "_encode_unit", noting)
    monkeypatch.setattr(RasterSource, "read", reading)
    at = "terrainwave.write.local.LocalPasses.prove"
    stopped(monkeypatch, lambda: terrainwave.compress(raster, target, **OPTIONS), at)
    first, first_reads = len(units), len(reads)
    units.clear()
    reads.clear()
    terrainwave.compress(raster, target, verify=True, **OPTIONS)
    # Units above the subtrees of 128 x 128: 1 + 1 + 4 + 16 of them at most.
    assert len(units) <= 22 < first
    assert len(reads) < first_reads / 2


@pytest.mark.full
def test_a_failed_run_says_how_to_go_on(tmp_path, raster, monkeypatch):
    target = tmp_path / "out.twz"
    arguments = ["compress", str(raster), str(target), "--block", "32", "--max-error", "1"]
    with monkeypatch.context() as broken:
        broken.setattr(
            "terrainwave.write.local.LocalPasses.prove",
            Mock(side_effect=StorageError("the disk is full")),
        )
        result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 1
    error, note = result.stderr.splitlines()
    assert error == "terrainwave: the disk is full"
    assert ".twz-kept: run the same command again to go on; --fresh starts over" in note
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0
    assert "the run continued the work of an earlier one; --fresh starts" in result.stderr
    assert hidden_in(tmp_path) == []


def interrupted(target, source, monkeypatch, **options):
    """Leave the work of a run that was stopped before its proof."""
    return stopped(
        monkeypatch,
        lambda: terrainwave.compress(source, target, **OPTIONS | options),
        "terrainwave.write.local.LocalPasses.prove",
        KeyboardInterrupt,
    )


def test_ctrl_c_keeps_what_is_finished(tmp_path, raster, monkeypatch):
    error = interrupted(tmp_path / "out.twz", raster, monkeypatch)
    assert any("run the same command again" in note for note in error.__notes__)
    (kept,) = hidden_in(tmp_path)
    # Nothing but what is kept: no spools of segments.
    names = os.listdir(tmp_path / kept)
    assert "journal" in names
    assert all(name == "journal" or name.endswith(".array") for name in names)


@pytest.mark.full
def test_work_of_other_options_is_removed_and_said(tmp_path, raster, monkeypatch):
    target = tmp_path / "out.twz"
    interrupted(target, raster, monkeypatch)
    with pytest.warns(TerrainwaveWarning, match="removed: it was made with other options"):
        result = terrainwave.compress(raster, target, **OPTIONS | {"max_error": 2})
    assert not any("continued the work" in note for note in result.notes)
    terrainwave.compress(raster, tmp_path / "b.twz", **OPTIONS | {"max_error": 2})
    assert target.read_bytes() == (tmp_path / "b.twz").read_bytes()


@pytest.mark.full
def test_work_of_a_source_that_has_changed_is_removed_and_said(tmp_path, raster, monkeypatch):
    target = tmp_path / "out.twz"
    interrupted(target, raster, monkeypatch)
    seen = os.stat(raster)
    with rasterio.open(raster, "r+") as dataset:
        heights = dataset.read(1)
        heights[0, 0] += 1
        dataset.write(heights, 1)
    os.utime(raster, ns=(seen.st_atime_ns, seen.st_mtime_ns))
    with pytest.warns(TerrainwaveWarning, match="the source was another one, or has changed"):
        terrainwave.compress(raster, target, **OPTIONS | {"max_error": 0})
    with terrainwave.open(target) as terrain:
        assert np.array_equal(terrain.read(), heights)


@pytest.mark.full
def test_heights_of_an_array_tell_whether_it_is_the_same(tmp_path, monkeypatch):
    heights, target = terrain_like(*SHAPE, seed=3), tmp_path / "out.twz"
    interrupted(target, heights, monkeypatch)
    result = terrainwave.compress(heights.copy(), target, **OPTIONS)
    assert any("continued the work" in note for note in result.notes)
    whole = target.read_bytes()
    assert whole == terrainwave.compress_to_bytes(heights, mesh="halves", digest=True, **OPTIONS)
    interrupted(target, heights, monkeypatch, overwrite=True)
    heights[5, 5] += 9
    with pytest.warns(TerrainwaveWarning, match="the source was another one"):
        terrainwave.compress(heights, target, overwrite=True, **OPTIONS)
    assert target.read_bytes() == terrainwave.compress_to_bytes(
        heights, mesh="halves", digest=True, **OPTIONS
    )


@pytest.mark.full
def test_fresh_starts_over(tmp_path, raster, monkeypatch):
    target = tmp_path / "out.twz"
    interrupted(target, raster, monkeypatch)
    result = terrainwave.compress(raster, target, fresh=True, **OPTIONS)
    assert not any("continued the work" in note for note in result.notes)
    assert hidden_in(tmp_path) == []


def test_heights_that_cannot_be_leave_nothing(tmp_path):
    heights = terrain_like(*SHAPE, dtype="float32")
    heights[600, 500] = np.inf
    with pytest.raises(InvalidHeightsError, match="inf"):
        terrainwave.compress(
            write_geotiff(tmp_path / "a.tif", heights), tmp_path / "out.twz", **OPTIONS
        )
    assert hidden_in(tmp_path) == []


@pytest.mark.few(1)
@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forks")
@pytest.mark.parametrize("has_original", [False, True])
def test_a_patch_goes_on_after_kills(tmp_path, raster, monkeypatch, has_original):
    heights = heights_with_voids()
    path, newer = tmp_path / "dem.twz", tmp_path / "new.tif"
    terrainwave.compress(raster, path, **OPTIONS)
    before = path.read_bytes()
    heights[300:500, 200:420] = np.where(heights[300:500, 200:420] == NODATA, 100, NODATA)
    write_geotiff(newer, heights, nodata=NODATA)
    original = newer if has_original else None

    def work():
        patch(path, newer, original=original, threads=2)

    total = n_records(work, monkeypatch)
    whole = path.read_bytes()
    assert whole != before
    path.write_bytes(before)
    for part in (1, total // 4, total // 3):
        assert killed_at(part, work)
        assert path.read_bytes() == before
    assert n_records(work, monkeypatch) < total * 0.8
    assert path.read_bytes() == whole
    assert hidden_in(tmp_path) == []


_HOLD = """
import sys
from pathlib import Path
from terrainwave.container.targets.publication import only_writer
path = Path(sys.argv[1])
with only_writer(path, path.parent, "it"):
    print("begun", flush=True)
    sys.stdin.read()
"""


@pytest.mark.full
def test_a_second_writer_of_the_same_target_is_refused_in_one_line(tmp_path, raster):
    target = tmp_path / "out.twz"
    source = tmp_path / "source.twz"
    terrainwave.compress(raster, target, **OPTIONS)
    before = target.read_bytes()
    source.write_bytes(before)
    with subprocess.Popen(
        [sys.executable, "-c", _HOLD, target], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout.readline() == b"begun\n"
        message = rf"another run is writing .*out\.twz \(process {other.pid}\)"
        with pytest.raises(StorageError, match=message):
            terrainwave.compress(raster, target, overwrite=True, **OPTIONS)
        with pytest.raises(StorageError, match=message):
            patch(target, raster)
        with pytest.raises(StorageError, match=message):
            terrainwave.store_meshes(source, target, overwrite=True)
        assert target.read_bytes() == before
        other.kill()  # who is gone holds nothing
    terrainwave.compress(raster, target, overwrite=True, **OPTIONS)
    assert hidden_in(tmp_path) == []


def stopped(monkeypatch, work, at="terrainwave.write.local.LocalPasses.encode", error=StorageError):
    """Run `work` to a failure after the scan, which leaves what is finished; return the error."""
    with monkeypatch.context() as broken:
        broken.setattr(at, Mock(side_effect=error("no more")))
        with pytest.raises(error) as caught:
            work()
    return caught.value


@pytest.mark.full
def test_sources_of_the_same_files_are_told_apart(tmp_path, monkeypatch):
    """Pages of one file: the file alone does not say which."""
    pages = tmp_path / "pages.tif"
    first, second = terrain_like(*SHAPE, seed=5), terrain_like(*SHAPE, seed=6) + 1000
    for page, heights in enumerate((first, second)):
        with rasterio.open(
            pages, "w", driver="GTiff", height=SHAPE[0], width=SHAPE[1], count=1, dtype="int16",
            APPEND_SUBDATASET=page > 0,
        ) as dataset:  # fmt: skip
            dataset.write(heights.astype(np.int16), 1)
    target = tmp_path / "out.twz"
    for before, asked, expected in (
        (f"GTIFF_DIR:1:{pages}", f"GTIFF_DIR:2:{pages}", second),
        (f"GTIFF_DIR:2:{pages}", f"GTIFF_DIR:1:{pages}", first),
    ):
        target.unlink(missing_ok=True)
        stopped(monkeypatch, lambda src=before: terrainwave.compress(src, target, **OPTIONS))
        with pytest.warns(TerrainwaveWarning, match="another one, or has changed"):
            terrainwave.compress(asked, target, **OPTIONS)
        with terrainwave.open(target) as terrain:
            assert np.abs(terrain.read().astype(int) - expected).max() <= 1


def test_a_digest_that_is_wanted_now_is_made(tmp_path, raster, monkeypatch):
    target = tmp_path / "out.twz"
    stopped(monkeypatch, lambda: terrainwave.compress(raster, target, **OPTIONS))
    with pytest.warns(TerrainwaveWarning, match="other options"):
        terrainwave.compress(raster, target, keep_origin=True, **OPTIONS)
    assert hidden_in(tmp_path) == []


@pytest.mark.full
@pytest.mark.parametrize("gone", ["heights", "valid", "seen", "nested-1", "own-1"])
def test_arrays_that_are_gone_are_made_again(tmp_path, raster, monkeypatch, gone):
    source, target = tmp_path / "striped.tif", tmp_path / "out.twz"
    terrainwave.compress(source, target, **OPTIONS)
    whole = target.read_bytes()

    def work():
        terrainwave.compress(source, target, overwrite=True, **OPTIONS)

    stopped(monkeypatch, work, "terrainwave.write.local.LocalPasses.prove")
    (folder,) = tmp_path.glob(".*.twz-kept")
    (folder / f"{gone}.array").unlink()
    work()
    assert target.read_bytes() == whole
