"""Many files by one command: compress, decompress and verify."""

import json
import os
import signal
import sys
import threading
import time

import numpy as np
import pytest
from commands import run, start
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
    assert done.exit_code == 0, done.stderr
    (note,) = [line for line in done.stderr.splitlines() if line.startswith("note: ")]
    assert "names no vertical unit" in note
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
    before = [file.read_bytes() for file in files]
    arguments = ["compress", *dems, "--to", tmp_path / "twz", *QUICK]
    done = run(*arguments, "--skip-existing")
    assert done.exit_code == 0
    assert done.stdout.splitlines()[-1] == "3 files: 0 compressed, 3 skipped"
    files[0].write_bytes(b"mine")
    done = run(*arguments)
    assert done.exit_code == 1
    assert done.stderr.count("--overwrite replaces it") == 3
    assert files[0].read_bytes() == b"mine"
    assert run(*arguments, "--overwrite").exit_code == 0
    assert [file.read_bytes() for file in files] == before


def in_json(done, paths):
    """Return the lines of --json, one for each file, in the order of the files."""
    found = {line["source"]: line for line in map(json.loads, done.stdout.splitlines())}
    assert found.keys() == set(map(str, paths))
    return [found[str(path)] for path in paths]


def batch_of(paths, directory, *options):
    """Run a batch of `compress` with --skip-existing; return what became of each, and the notes."""
    done = run("compress", *paths, "--to", directory, "--skip-existing", "--json", *QUICK, *options)
    assert done.exit_code == 0, done.stderr
    notes = [line for line in done.stderr.splitlines() if "made again" in line]
    return [file["status"] for file in in_json(done, paths)], notes


@pytest.fixture
def reads(monkeypatch):
    """Count the windows that are read of rasters."""
    from terrainwave.raster_io.source import RasterSource

    counted = []
    read = RasterSource.read

    def counting(self, *window):
        counted.append(self.name)
        return read(self, *window)

    monkeypatch.setattr(RasterSource, "read", counting)
    return counted


def rewrite(path, heights):
    """Replace a raster by another one of the same size, as old as before."""
    before = path.stat()
    write_geotiff(path, heights)
    assert path.stat().st_size == before.st_size
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def test_what_the_manifest_knows_is_not_read(tmp_path, dems, reads):
    assert batch_of(dems, tmp_path / "out") == (["compressed"] * 3, [])
    reads.clear()
    assert batch_of(dems, tmp_path / "out") == (["skipped"] * 3, [])
    assert reads == []


def test_without_a_manifest_heights_are_compared(tmp_path, dems, files, reads):
    out = tmp_path / "twz"
    reads.clear()
    assert batch_of(dems, out) == (["skipped"] * 3, [])
    assert len(reads) == 3
    reads.clear()
    assert batch_of(dems, out) == (["skipped"] * 3, [])
    assert reads == []


@pytest.mark.parametrize("has_manifest", [True, False])
def test_a_replaced_source_is_done_again(tmp_path, dems, has_manifest):
    out = tmp_path / "out"
    batch_of(dems, out)
    heights = read_geotiff(dems[1])[0]
    heights[0, :2] = heights[0, 1::-1] + [0, 1]
    rewrite(dems[1], heights)
    if not has_manifest:
        (out / ".terrainwave-manifest.jsonl").unlink()
    found, notes = batch_of(dems, out)
    assert found == ["skipped", "compressed", "skipped"]
    assert notes == [f"note: {out / 'b.twz'} is made again: it was made of other heights"]
    with terrainwave.open(out / "b.twz") as terrain:
        assert np.abs(terrain.read().astype(int) - heights).max() <= 1
    assert batch_of(dems, out)[0] == ["skipped"] * 3


@pytest.mark.parametrize(
    "options",
    [
        ["--max-error", 2],
        ["--max-error", 0],
        ["--method", "predictive"],
        ["--block", 64],
        ["--mesh", "halves"],
        ["-o", "border_rings=3"],
        ["--nodata", 7],
        pytest.param(["--effort", "fast", "--method", "predictive"], marks=pytest.mark.full),
        ["--effort", "best"],
        ["--strict"],
    ],
    ids=lambda options: "_".join(map(str, options)),
)
@pytest.mark.parametrize("has_manifest", [True, False])
def test_other_options_are_done_again(tmp_path, dems, options, has_manifest):
    out = tmp_path / "out"
    quick = [option for option in options if option != "--mesh"]
    assert batch_of(dems[:1], out)[0] == ["compressed"]
    if not has_manifest:
        (out / ".terrainwave-manifest.jsonl").unlink()
    more = options if quick == options else ["--mesh", "halves"]
    command = ["compress", dems[0], "--to", out, "--skip-existing", *QUICK]
    if quick != options:
        command.remove("--no-mesh")
    for expected in ("1 compressed", "0 compressed, 1 skipped"):
        done = run(*command, *more)
        assert done.exit_code == 0, done.stderr
        assert done.stdout.splitlines()[-1] == f"1 file: {expected}"


def test_a_file_without_proof_is_done_again_where_one_is_wanted(tmp_path, dems):
    out = tmp_path / "out"
    assert batch_of(dems, out, "--no-verify")[0] == ["compressed"] * 3
    found, notes = batch_of(dems, out)
    assert found == ["compressed"] * 3
    assert all(note.endswith("it was made with other options") for note in notes)


def test_a_source_that_was_only_touched_is_skipped(tmp_path, dems):
    batch_of(dems, tmp_path / "out")
    for dem in dems:
        os.utime(dem)
    assert batch_of(dems, tmp_path / "out") == (["skipped"] * 3, [])


@pytest.mark.parametrize("has_manifest", [True, False])
def test_another_place_or_tag_is_done_again(tmp_path, dems, has_manifest):
    import rasterio

    out = tmp_path / "out"
    batch_of(dems, out)
    if not has_manifest:
        (out / ".terrainwave-manifest.jsonl").unlink()
    with rasterio.open(dems[0], "r+") as dataset:
        dataset.crs = "EPSG:32633"
        dataset.transform = rasterio.Affine(30, 0, 5e5, 0, -30, 5e6)
    with rasterio.open(dems[2], "r+") as dataset:
        dataset.update_tags(SOURCE="another survey")
    assert batch_of(dems, out)[0] == ["compressed", "skipped", "compressed"]
    with terrainwave.open(out / "a.twz") as terrain:
        assert terrain.raster_info.crs == "EPSG:32633"


def test_a_target_that_is_no_longer_what_was_made_is_done_again(tmp_path, dems):
    out = tmp_path / "out"
    batch_of(dems, out)
    whole = (out / "a.twz").read_bytes()
    (out / "a.twz").write_bytes(whole[:-1])
    (out / "b.twz").write_bytes(b"mine")
    (out / "c.twz").write_bytes((out / "a.twz").read_bytes() + whole[-1:])
    assert batch_of(dems, out)[0] == ["compressed"] * 3
    assert (out / "a.twz").read_bytes() == whole


def test_a_change_below_two_vrts_is_noticed(tmp_path, dems):
    """GDAL lists the files of a VRT, but not those that its sources are made of."""
    vrt = (
        '<VRTDataset rasterXSize="10" rasterYSize="12"><VRTRasterBand dataType="{}" band="1">'
        "<SimpleSource><SourceFilename>{}</SourceFilename><SourceBand>1</SourceBand>"
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    kind = {"int16": "Int16", "float32": "Float32"}[read_geotiff(dems[0])[0].dtype.name]
    (tmp_path / "inner.vrt").write_text(vrt.format(kind, dems[0]))
    (tmp_path / "outer.vrt").write_text(vrt.format(kind, tmp_path / "inner.vrt"))
    outer = [tmp_path / "outer.vrt"]
    assert batch_of(outer, tmp_path / "out")[0] == ["compressed"]
    assert batch_of(outer, tmp_path / "out")[0] == ["skipped"]
    rewrite(dems[0], read_geotiff(dems[0])[0] + np.int16(3))
    assert batch_of(outer, tmp_path / "out")[0] == ["compressed"]


def test_a_mask_that_is_new_beside_a_raster_is_noticed(tmp_path, dems):
    import rasterio

    batch_of(dems, tmp_path / "out")
    valid = np.full(read_geotiff(dems[1])[0].shape, 255, np.uint8)
    valid[2, 3] = 0
    outside = rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False)
    with outside, rasterio.open(dems[1], "r+") as dataset:
        dataset.write_mask(valid)
    assert (dems[1].parent / "b.tif.msk").exists()
    assert batch_of(dems, tmp_path / "out")[0] == ["skipped", "compressed", "skipped"]


@pytest.mark.parametrize(
    "damage", [b"", b"{", b"[1]\n\n{}", b"\xff\x00" * 9, b'{"target": "a.twz"}']
)
def test_a_damaged_manifest_is_as_none(tmp_path, dems, damage):
    out = tmp_path / "out"
    batch_of(dems, out)
    manifest = out / ".terrainwave-manifest.jsonl"
    manifest.write_bytes(damage)
    assert batch_of(dems, out) == (["skipped"] * 3, [])
    assert batch_of(dems, out) == (["skipped"] * 3, [])


def test_rasters_are_skipped_only_if_they_are_of_the_same_file_and_options(tmp_path, dems, files):
    back = tmp_path / "back"

    def decompressed(*options):
        done = run("decompress", *files, "--to", back, *options)
        assert done.exit_code == 0, done.stderr
        return done.stdout.splitlines()[-1]

    assert decompressed() == "3 files: 3 decompressed"
    assert decompressed("--skip-existing") == "3 files: 0 decompressed, 3 skipped"
    some = "3 files: 3 decompressed"
    assert decompressed("--skip-existing", "--window", "0,0,5,5") == some
    assert read_geotiff(back / "a.tif")[0].shape == (5, 5)
    assert decompressed("--skip-existing") == some
    assert run("compress", dems[0], files[1], *QUICK, "--overwrite").exit_code == 0
    assert decompressed("--skip-existing") == "3 files: 1 decompressed, 2 skipped"
    (back / "c.tif").write_bytes(b"mine")
    assert decompressed("--skip-existing") == "3 files: 1 decompressed, 2 skipped"
    assert decompressed("--skip-existing") == "3 files: 0 decompressed, 3 skipped"


def test_a_raster_of_which_nothing_is_known_is_never_replaced(tmp_path, dems, files):
    """It may be the original."""
    before = [dem.read_bytes() for dem in dems]
    done = run("decompress", *files, "--to", tmp_path / "dems", "--skip-existing")
    assert done.exit_code == 1
    assert done.stderr.count("no manifest says what it was made of") == 3
    assert [dem.read_bytes() for dem in dems] == before
    dems[0].write_text("no raster")
    done = run("decompress", *files, "--to", tmp_path / "dems", "--skip-existing")
    assert done.stdout.splitlines()[-1] == "3 files: 1 decompressed, 2 failed"


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
    assert f"{files[2]}: found no raster c in" in done.stderr
    assert done.stdout.splitlines()[-1] == "3 files: 2 ok, 1 failed"
    assert run("decompress", *files, "--to", tmp_path / "out", "--level", 99).exit_code == 2
    assert not (tmp_path / "out").exists()


def test_json_is_a_line_for_each_file(tmp_path, dems):
    dems[1].write_text("no raster")
    done = run("compress", *dems, "--to", tmp_path / "out", *QUICK, "--json")
    found = in_json(done, dems)
    assert [file["status"] for file in found] == ["compressed", "failed", "compressed"]
    assert found[2]["n_bytes"] == (tmp_path / "out" / "c.twz").stat().st_size
    assert all(file["seconds"] >= 0 for file in found)
    assert "not a raster" in found[1]["error"]
    assert found[1]["error_class"] == "StorageError"
    done = run("verify", *(tmp_path / "out").glob("*.twz"), "--json")
    assert [json.loads(line)["status"] for line in done.stdout.splitlines()] == ["ok", "ok"]


def test_lines_of_json_come_while_the_batch_runs(tmp_path):
    """The second raster is a pipe that nobody fills until the first line is there."""
    first = write_geotiff(tmp_path / "first.tif", terrain_like(12, 10))
    second = write_geotiff(tmp_path / "second.tif", terrain_like(12, 10))
    seen, work = [], threading.Event()

    def do(job, threads, progress):
        if job.source == str(second):
            assert work.wait(60)
        return batch.Done("done", {"n_bytes": 1})

    def told(fields):
        seen.append(fields["source"])
        work.set()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "print_json_line", told)
        jobs = [batch.FileJob(str(path)) for path in (second, first)]
        assert batch.run(jobs, do, word="done", threads=2, as_json=True, quiet=False) == 0
    assert seen == [str(first), str(second)]


def two_hundred_rasters(folder, bad):
    """Return the rasters, and those of them that are none, as `bad` numbers them."""
    rasters = [
        write_geotiff(folder / f"{number:03}.tif", terrain_like(9, 8, seed=number))
        for number in range(200)
    ]
    spoilt = [rasters[number] for number in bad]
    for path in spoilt:
        path.write_bytes(b"II*\0 no raster")
    return rasters, spoilt


@pytest.mark.full
def test_a_batch_that_is_killed_twice_goes_on_where_it_was(tmp_path):
    """200 files, 3 of them bad: killed without warning, between and within files."""
    rasters, bad = two_hundred_rasters(tmp_path, (3, 90, 150))
    out = tmp_path / "out"
    command = [
        "compress", *rasters, "--to", out, "--skip-existing", "--json", "--no-mesh",
        "--max-error", "0", "--block", "32",
    ]  # fmt: skip
    for n_made in (30, 110):
        with start(*map(str, command)) as process:
            while len(list(out.glob("*.twz"))) < n_made:
                assert process.poll() is None
                time.sleep(0.005)
            process.kill()
            process.communicate()
    there = {path.name for path in out.glob("*.twz")}
    assert 110 <= len(there) < 197
    done = run(*command)
    assert done.exit_code == 1
    found = in_json(done, rasters)
    failed = {file["source"]: file for file in found if file["status"] == "failed"}
    assert list(failed) == list(map(str, bad)), failed
    assert sum(file["status"] == "skipped" for file in found) >= 109
    assert {file["status"] for file in found} == {"failed", "skipped", "compressed"}
    for path in rasters:
        if path not in bad:
            with terrainwave.open(out / f"{path.stem}.twz") as terrain:
                assert np.array_equal(terrain.read(), read_geotiff(path)[0])
    # Nothing unfinished is left beside them.
    assert len([path for path in out.iterdir() if "part" in path.name]) == 0
    assert len(list(out.glob("*.twz"))) == 197


@pytest.mark.full
@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
def test_a_signal_ends_all_jobs_and_leaves_what_is_finished(tmp_path):
    rng = np.random.default_rng(0)
    for name in "bc":
        heights = rng.integers(0, 9999, (1500, 1500)).astype("int16")
        write_geotiff(tmp_path / f"{name}.tif", heights)
    out = tmp_path / "out"
    sources = [tmp_path / "b.tif", tmp_path / "c.tif"]
    process = start("compress", *sources, "--to", out, "--max-error", 1, "--threads", 2)
    while not (out.exists() and len(os.listdir(out)) >= 2):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 143, stderr
    assert not out.exists() or set(os.listdir(out)) <= {"b.twz", "c.twz"}


def test_an_original_must_be_one(tmp_path):
    for name in ("a.tif", "a.vrt", "a.twz", "a.json"):
        (tmp_path / name).write_text("")
    with pytest.raises(StorageError, match=r"a\.tif, .*a\.vrt in .*, expected one, as a.tif"):
        batch.find_original("x/a.twz", tmp_path)
    (tmp_path / "a.vrt").unlink()
    assert batch.find_original("x/a.twz", tmp_path) == str(tmp_path / "a.tif")


def test_a_folder_stands_for_the_files_below_it(tmp_path):
    """Folders are kept; hidden files, other files and the target's own are left out."""
    folder = tmp_path / "in"
    for place in ("", "x", "x/y", ".hidden"):
        (folder / place).mkdir(exist_ok=True)
        write_geotiff(folder / place / "a.TIF", terrain_like(12, 10, seed=len(place)))
    (folder / "x" / "notes.txt").write_text("no raster")
    out = folder / "out"
    for word in ("3 compressed", "3 skipped"):
        done = run("compress", folder, "--to", out, *QUICK, "--skip-existing")
        assert done.exit_code == 0, done.stderr
        assert word in done.stdout
    files = sorted(path.relative_to(out).as_posix() for path in out.rglob("*.twz"))
    assert files == ["a.twz", "x/a.twz", "x/y/a.twz"]
    done = run("verify", out, "--originals", folder)
    assert (done.exit_code, done.stdout.count("120 heights compared")) == (0, 3), done.stderr
    assert run("verify", out).exit_code == 0
    done = run("decompress", out, "--to", tmp_path / "back")
    assert done.exit_code == 0, done.stderr
    for path in files:
        found = read_geotiff(tmp_path / "back" / path.replace(".twz", ".tif"))[0]
        assert np.abs(found - read_geotiff(folder / path.replace(".twz", ".TIF"))[0]).max() <= 1


def test_a_folder_without_a_fitting_file_is_wrong_usage(tmp_path):
    (tmp_path / "in").mkdir()
    for command in (("compress", "--to", tmp_path / "out"), ("verify",)):
        done = run(command[0], tmp_path / "in", *command[1:])
        assert done.exit_code == 2
        assert "found no file in" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_manifest_does_not_grow_with_the_number_of_runs(tmp_path, dems):
    out = tmp_path / "out"
    batch_of(dems[:1], out)
    manifest = out / ".terrainwave-manifest.jsonl"
    line = manifest.read_text().splitlines()[-1]
    manifest.write_text("\n".join([line] * 500))
    assert batch_of(dems[:1], out)[0] == ["skipped"]
    assert len(manifest.read_text().splitlines()) < 10
