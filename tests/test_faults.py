"""Faults: the target is absent, its old self, or complete, and nothing is left over."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from commands import python_with
from strategies import terrain_like, write_geotiff

from terrainwave.cli import main
from terrainwave.codec import group
from terrainwave.codec.refiner import Validity
from terrainwave.container.spool import SectionFile
from terrainwave.errors import (
    BoundViolationError,
    CorruptStreamError,
    InvalidHeightsError,
    StorageError,
)
from terrainwave.export.geotiff import decompress
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.temporary import Spool
from terrainwave.terrain import Terrain
from terrainwave.write.compress import compress

HEIGHTS = terrain_like(9, 8)
LARGE = terrain_like(300, 300)
OLD = b"what was there before"
OPTIONS = {"max_error": 1, "block": 32, "threads": 1}


@pytest.fixture(params=["new", "existing"])
def target(request, tmp_path):
    """Return a path that does not exist, or one that does."""
    path = tmp_path / request.param / "dem.twz"
    path.parent.mkdir()
    if request.param == "existing":
        path.write_bytes(OLD)
    return path


@pytest.fixture
def tiff(target):
    """Return the same as `target` for a GeoTIFF."""
    path = target.with_suffix(".tif")
    if target.exists():
        target.rename(path)
    return path


def is_as_it_was(target):
    if target.parent.name == "new":
        return not target.exists()
    return target.read_bytes() == OLD


def assert_untouched(target):
    """The target is as it was, and its directory holds nothing else."""
    assert is_as_it_was(target)
    assert set(os.listdir(target.parent)) <= {target.name}


@pytest.fixture
def everything_on_disk(monkeypatch):
    """Make all temporary data go to files."""
    monkeypatch.setattr("terrainwave.raster_io.temporary.MEMORY_LIMIT", 0)
    monkeypatch.setattr("terrainwave.container.spool._BUFFER", 0)


def full_disk(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class FullFile:
    """A file on a full disk."""

    def __init__(self, file):
        self._file = file

    def __getattr__(self, name):
        return full_disk if name == "write" else getattr(self._file, name)


def test_a_full_disk_at_the_end_leaves_the_target_as_it_was(monkeypatch, target):
    # Network and delayed writes fail here first.
    monkeypatch.setattr("terrainwave.container.targets.publication.os.fsync", full_disk)
    with pytest.raises(StorageError, match="disk is full"):
        compress(HEIGHTS, target, overwrite=True, **OPTIONS)
    assert_untouched(target)


def test_a_full_disk_while_spooling_payloads_leaves_the_target_as_it_was(
    monkeypatch, target, everything_on_disk
):
    monkeypatch.setattr("terrainwave.container.spool.tempfile.TemporaryFile", full_disk)
    with pytest.raises(StorageError, match="disk is full"):
        compress(HEIGHTS, target, overwrite=True, **OPTIONS)
    assert_untouched(target)


@pytest.mark.large
def test_a_full_disk_while_spooling_levels_leaves_the_target_as_it_was(
    monkeypatch, target, everything_on_disk
):
    made = Spool.__init__

    def full(self, *arguments):
        made(self, *arguments)
        self._file = FullFile(self._file)

    monkeypatch.setattr(Spool, "__init__", full)
    with pytest.raises(StorageError, match=r"temporary files in .*: the disk is full; .* temp_dir"):
        compress(LARGE, target, overwrite=True, **OPTIONS)
    assert_untouched(target)


def test_too_little_free_space_is_noticed_before_work_begins(monkeypatch, target, tmp_path):
    usage = type("Usage", (), {"free": 10})
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    with pytest.raises(StorageError, match="temp_dir"):
        compress(HEIGHTS, target, overwrite=True, **OPTIONS)
    assert_untouched(target)


def test_a_full_disk_while_decompressing_leaves_the_target_as_it_was(monkeypatch, tiff, tmp_path):
    compress(HEIGHTS, tmp_path / "dem.twz", **OPTIONS)
    monkeypatch.setattr("terrainwave.container.targets.publication.os.fsync", full_disk)
    with pytest.raises(StorageError, match="disk is full"):
        decompress(tmp_path / "dem.twz", tiff, overwrite=True, threads=1)
    assert_untouched(tiff)


@pytest.mark.parametrize("tiled", [False, True])
def test_a_truncated_tiff_leaves_the_target_as_it_was(target, tmp_path, tiled):
    blocks = {"blockxsize": 64, "blockysize": 64} if tiled else {"blockysize": 8}
    source = write_geotiff(tmp_path / "dem.tif", LARGE, tiled=tiled, **blocks)
    source.write_bytes(source.read_bytes()[: source.stat().st_size * 6 // 10])
    with pytest.raises(StorageError, match=r"rows .* cannot be read"):
        compress(source, target, overwrite=True, **OPTIONS)
    assert_untouched(target)


@pytest.mark.large
@pytest.mark.parametrize("n_good", [1, 2, 9, 25])
def test_a_source_that_fails_later_leaves_the_target_as_it_was(monkeypatch, target, n_good):
    read = RasterSource.read
    n_reads = 0

    def failing(self, *window):
        nonlocal n_reads
        n_reads += 1
        if n_reads > n_good:
            raise StorageError("the network share is gone")
        return read(self, *window)

    monkeypatch.setattr(RasterSource, "read", failing)
    with pytest.raises(StorageError, match="gone"):
        compress(LARGE, target, overwrite=True, **OPTIONS)
    assert n_reads > n_good
    assert_untouched(target)


def test_heights_that_cannot_be_coded_leave_the_target_as_it_was(target):
    heights = np.array([[1.0, np.inf]])
    with pytest.raises(InvalidHeightsError):
        compress(heights, target, overwrite=True, **OPTIONS)
    assert_untouched(target)


@pytest.mark.few(5)
@pytest.mark.large
@pytest.mark.parametrize("stage", ["scanning", "making levels", "encoding", "proving"])
@pytest.mark.parametrize("threads", [1, 3])
def test_an_interrupt_leaves_the_target_as_it_was(
    monkeypatch, target, stage, threads, everything_on_disk
):
    monkeypatch.setattr("terrainwave.progress._INTERVAL", 0)
    seen = []

    def interrupt(progress):
        seen.append(progress.stage)
        if progress.stage == stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compress(
            LARGE, target, overwrite=True, progress=interrupt, **{**OPTIONS, "threads": threads}
        )
    assert stage in seen
    assert_untouched(target)


def test_an_interrupt_while_decompressing_leaves_the_target_as_it_was(tiff, tmp_path):
    compress(HEIGHTS, tmp_path / "dem.twz", **OPTIONS)

    def interrupt(progress):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        decompress(tmp_path / "dem.twz", tiff, overwrite=True, threads=1, progress=interrupt)
    assert_untouched(tiff)


# Stops for good at the first report of a stage, so that it can be killed there.
KILLED = """
import sys, time
import numpy as np
from terrainwave import progress
from terrainwave.write.compress import compress
progress._INTERVAL = 0
def stop(state):
    if state.stage == sys.argv[3]:
        print("here", flush=True)
        time.sleep(100)
compress(np.load(sys.argv[1]), sys.argv[2], max_error=1, block=32, overwrite=True, progress=stop)
"""


def kill_at(stage, source, target):
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, source, target, stage], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout.readline().strip() == b"here"
        process.kill()
        process.wait()


@pytest.mark.large
@pytest.mark.parametrize(
    "stage",
    [
        pytest.param("scanning", marks=pytest.mark.full),
        "encoding",
        pytest.param("proving", marks=pytest.mark.full),
    ],
)
def test_after_a_kill_the_target_is_as_it_was_and_the_next_run_cleans_up(stage, target, tmp_path):
    np.save(tmp_path / "heights.npy", LARGE)
    kill_at(stage, tmp_path / "heights.npy", target)
    assert is_as_it_was(target)
    left_over = set(os.listdir(target.parent)) - {target.name}
    assert left_over  # what a killed run cannot help
    compress(LARGE, target, overwrite=True, **OPTIONS)
    assert os.listdir(target.parent) == [target.name]
    with Terrain(target) as terrain:
        assert np.abs(terrain.read().astype(int) - LARGE).max() <= 1


def wrong_by(monkeypatch, change):
    """Make every decoder return units changed by `change`; encoders stay right."""
    decode = group.decode_unit

    def wrong(*arguments):
        return change(decode(*arguments))

    monkeypatch.setattr(group, "decode_unit", wrong)


def higher(unit):
    heights = unit.heights.copy()
    heights[-1, -1] += 3
    return unit._replace(heights=heights)


def holed(unit):
    mask = unit.mask.copy()
    mask[2, 3] = False
    return unit._replace(validity=Validity(mask))


def test_a_wrong_height_is_found_and_the_target_is_as_it_was(
    monkeypatch, target, everything_on_disk
):
    wrong_by(monkeypatch, higher)
    with pytest.raises(BoundViolationError, match=r"row 8, column 7 is [34] off, more than 1"):
        compress(HEIGHTS, target, overwrite=True, method="predictive", **OPTIONS)
    assert_untouched(target)


def test_a_wrong_mask_is_found_and_the_target_is_as_it_was(monkeypatch, target):
    wrong_by(monkeypatch, holed)
    with pytest.raises(BoundViolationError, match=r"mask differs .* row 2, column 3"):
        compress(HEIGHTS, target, overwrite=True, **OPTIONS)
    assert_untouched(target)


def test_a_wrong_height_is_one_line_and_status_1(monkeypatch, target, tmp_path):
    source = write_geotiff(tmp_path / "dem.tif", HEIGHTS)
    wrong_by(monkeypatch, higher)
    arguments = ["compress", str(source), str(target), "--max-error", "1", "--overwrite"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == 1
    assert_untouched(target)


def test_an_error_exactly_at_the_bound_is_not_a_violation(monkeypatch, tmp_path):
    # Heights 0 and 2 with a bound of 1: decoded as 1, both are 1 off.
    heights = np.array([[0, 2, 1]], dtype="int16")
    result = compress(heights, tmp_path / "dem.twz", method="store", **OPTIONS)
    assert result.measured_error == 1


def test_a_damaged_spool_is_noticed(tmp_path, monkeypatch, target, everything_on_disk):
    write = SectionFile._write

    def damaging(self):
        write(self)
        self._file.seek(0)
        self._file.write(b"\xff\xff\xff")

    monkeypatch.setattr(SectionFile, "_write", damaging)
    with pytest.raises(StorageError, match="damaged"):
        compress(HEIGHTS, target, overwrite=True, **OPTIONS)
    assert_untouched(target)


@pytest.mark.large
def test_a_damaged_file_leaves_the_target_of_decompress_as_it_was(tiff, tmp_path):
    compress(LARGE, tmp_path / "dem.twz", digest=False, **OPTIONS)
    damaged = bytearray((tmp_path / "dem.twz").read_bytes())
    damaged[-10] ^= 1
    (tmp_path / "bad.twz").write_bytes(damaged)
    with pytest.raises(CorruptStreamError, match="group"):
        decompress(tmp_path / "bad.twz", tiff, overwrite=True)
    assert_untouched(tiff)


@pytest.mark.full
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the trials need Linux")
def test_a_few_trials_of_each_kind_find_no_fault(tmp_path):
    few = "--side 200 --kills 1 --signals 2 --disks 1 --pairs 1 --forks 1 --opens 10".split()
    few += ["--commands", "compress", "patch", "decompress", "verify", "view"]
    words = ["-m", "faults.run", *few, "--out", tmp_path]
    # Its status is 1 where a trial found a fault.
    python_with(
        words, check=True, cwd=Path(__file__).parents[1], timeout=None, capture_output=False
    )
    names = {path.stem.removeprefix("faults_") for path in tmp_path.glob("*.csv")}
    assert names == {"kills", "signals", "disk", "writers", "opens", "readers", "network"}
