"""Many files by one command: compress, decompress and verify."""

import json
import os
import signal
import sys
import time

import numpy as np
import pytest
from commands import one_line, run, start
from strategies import read_geotiff, terrain_like, write_geotiff

import terrainwave
from terrainwave.cli import batch
from terrainwave.errors import StorageError

QUICK = ["--method", "store", "--block", 32, "--no-mesh", "--max-error", 1]


@pytest.fixture
def dems(tmp_path):
    """Return three rasters; together they are no mosaic."""
    (tmp_path / "dems").mkdir()
    return [
        write_geotiff(tmp_path / "dems" / f"{name}.tif", terrain_like(12 + number, 10))
        for number, name in enumerate("abc")
    ]


@pytest.fixture
def files(tmp_path, dems):
    assert run("compress", *dems, "--to", tmp_path / "twz", *QUICK, "-q").exit_code == 0
    return sorted((tmp_path / "twz").iterdir())


def test_each_raster_becomes_a_file_of_its_own_and_comes_back(tmp_path, dems):
    done = run("compress", *dems, "--to", tmp_path / "new" / "twz", *QUICK)
    assert (done.exit_code, done.stderr.replace("note: ", "")) == (0, done.stderr)
    assert len(done.stdout.splitlines()) == 4
    assert done.stdout.splitlines()[-1] == "3 files: 3 compressed"
    files = sorted((tmp_path / "new" / "twz").iterdir())
    assert [file.name for file in files] == ["a.twz", "b.twz", "c.twz"]
    done = run("decompress", *files, "--to", tmp_path / "back")
    assert (done.exit_code, done.stdout.splitlines()[-1]) == (0, "3 files: 3 decompressed")
    for dem in dems:
        heights = read_geotiff(tmp_path / "back" / dem.name)[0]
        assert np.abs(heights.astype(int) - read_geotiff(dem)[0]).max() <= 1
    done = run("verify", *files, "--originals", tmp_path / "dems")
    assert (done.exit_code, done.stdout.splitlines()[-1]) == (0, "3 files: 3 ok")


def test_a_file_that_fails_does_not_stop_the_others(tmp_path, dems):
    dems[1].write_text("no raster")
    done = run("compress", *dems, tmp_path / "none.tif", "--to", tmp_path / "out", *QUICK)
    assert done.exit_code == 1
    assert sorted(os.listdir(tmp_path / "out")) == ["a.twz", "c.twz"]
    assert done.stdout.splitlines()[-1] == "4 files: 2 compressed, 2 failed"
    failed = [line for line in done.stderr.splitlines() if line.startswith("terrainwave: ")]
    assert len(failed) == 2
    assert any(f"{dems[1]} is not a raster" in line for line in failed)
    assert any("none.tif: no such file" in line for line in failed)


def test_nothing_is_left_where_all_fail(tmp_path):
    done = run("compress", tmp_path / "a.tif", "--to", tmp_path / "new" / "out", *QUICK)
    assert done.exit_code == 1
    assert os.listdir(tmp_path) == []


def test_what_is_there_is_skipped_kept_or_replaced(tmp_path, dems, files):
    files[0].write_bytes(b"mine")
    arguments = ["compress", *dems, "--to", tmp_path / "twz", *QUICK]
    done = run(*arguments, "--skip-existing")
    assert done.exit_code == 0
    assert done.stdout.splitlines()[-1] == "3 files: 0 compressed, 3 skipped"
    done = run(*arguments)
    assert done.exit_code == 1
    assert done.stderr.count("--overwrite replaces it") == 3
    assert files[0].read_bytes() == b"mine"
    assert run(*arguments, "--overwrite").exit_code == 0
    assert files[0].read_bytes() != b"mine"


def test_a_damaged_file_among_many_is_found(files):
    data = bytearray(files[1].read_bytes())
    data[-20] ^= 1
    files[1].write_bytes(data)
    done = run("verify", *files)
    assert done.exit_code == 1
    assert done.stdout.splitlines()[-1] == "3 files: 2 ok, 1 failed"
    assert f"{files[1]}: not ok, " in done.stdout


def test_a_missing_original_is_a_failure_of_its_file(tmp_path, dems, files):
    dems[2].unlink()
    done = run("verify", *files, "--originals", tmp_path / "dems")
    assert done.exit_code == 1
    assert f"{files[2]}: found none, expected one raster c in" in done.stderr
    assert done.stdout.splitlines()[-1] == "3 files: 2 ok, 1 failed"


def test_json_lists_all_files_in_their_order(tmp_path, dems):
    dems[1].write_text("no raster")
    done = run("compress", *dems, "--to", tmp_path / "out", *QUICK, "--json")
    found = json.loads(done.stdout)["files"]
    assert [file["status"] for file in found] == ["compressed", "failed", "compressed"]
    assert [file["source"] for file in found] == list(map(str, dems))
    assert found[2]["n_bytes"] == (tmp_path / "out" / "c.twz").stat().st_size
    assert "not a raster" in found[1]["error"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compress", "x/a.tif", "y/A.tif", "--to", "out"], "would both be"),
        (["compress", "-", "--to", "out"], "found - and --to"),
        (["compress", "--to", "out"], "Missing argument 'SOURCE'"),
        (["compress", "a.tif", "--to", "out", "--scheduler", "x"], "found --scheduler and --to"),
        (["compress", "a.tif", "--to", "-"], "expected a directory"),
        (["compress", "a.tif", "b.twz", "--skip-existing"], "found --skip-existing without --to"),
        (
            ["decompress", "a.twz", "--to", "out", "--skip-existing", "--overwrite"],
            "found --skip-existing and --overwrite",
        ),
        (["decompress", "a.twz", "b.twz", "c.twz"], "add --to DIR"),
        (["decompress", "a.twz"], "Missing argument 'TARGET'"),
        (["verify", "a.twz", "b.twz", "c.tif"], "--originals DIR"),
        (["verify"], "Missing argument 'FILE'"),
    ],
)
def test_wrong_usage_writes_nothing(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert message in one_line(run(*arguments), 2)
    assert os.listdir(tmp_path) == []


def test_options_that_fit_no_file_are_wrong_usage(tmp_path, files):
    done = run("decompress", *files, "--to", tmp_path / "out", "--level", 99)
    assert done.exit_code == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("threads", "each"), [(1, 1), (3, 1), (7, 2)])
def test_threads_are_shared(monkeypatch, threads, each):
    running, most, shares = set(), [], set()

    def work(job, n_threads, progress):
        running.add(job)
        time.sleep(0.02)
        most.append(len(running))
        shares.add(n_threads)
        running.remove(job)
        return batch.Done(job.source)

    jobs = [batch.Job(str(number)) for number in range(6 if threads == 1 else 3)]
    found, status = batch.run(jobs, work, word="done", threads=threads, quiet=True)
    assert (len(found), status, shares) == (len(jobs), 0, {each})
    assert max(most) * each <= threads


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
def test_a_signal_ends_all_jobs_and_leaves_what_is_finished(tmp_path):
    rng = np.random.default_rng(0)
    for name in "bc":
        heights = rng.integers(0, 9999, (1500, 1500)).astype("int16")
        write_geotiff(tmp_path / f"{name}.tif", heights)
    out = tmp_path / "out"
    sources = [tmp_path / "b.tif", tmp_path / "c.tif"]
    process = start("compress", *sources, "--to", out, "--max-error", 1, "--threads", 2)
    deadline = time.monotonic() + 200
    while not (out.exists() and len(os.listdir(out)) >= 2) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 143, stderr
    assert not out.exists() or set(os.listdir(out)) <= {"b.twz", "c.twz"}


def test_lack_of_memory_is_a_failure_of_one_file(tmp_path, dems, monkeypatch):
    compress = terrainwave.compress

    def greedy(source, *arguments, **options):
        if source.endswith("b.tif"):
            raise MemoryError
        return compress(source, *arguments, **options)

    monkeypatch.setattr(terrainwave, "compress", greedy)
    done = run("compress", *dems, "--to", tmp_path / "out", *QUICK)
    assert done.exit_code == 1
    assert "b.tif: out of memory" in done.stderr


def test_an_original_must_be_one(tmp_path):
    for name in ("a.tif", "a.vrt", "a.twz", "a.json"):
        (tmp_path / name).write_text("")
    with pytest.raises(StorageError, match=r"a\.tif, .*a\.vrt, expected one raster a"):
        batch.find_original("x/a.twz", str(tmp_path))
    (tmp_path / "a.vrt").unlink()
    assert batch.find_original("x/a.twz", str(tmp_path)) == str(tmp_path / "a.tif")
