"""Commands, their output, and the exit status."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from commands import one_line, python, run, start
from rasterio.transform import Affine
from reference import recursive_errors
from strategies import read_geotiff, terrain_like, write_geotiff

import terrainwave
from terrainwave import interrupts
from terrainwave.cli import main, signals
from terrainwave.cli import output as cli_output
from terrainwave.cli.output import Bar, plain
from terrainwave.cli.signals import Terminated, ending_by_signals
from terrainwave.errors import StorageError
from terrainwave.grid.quadtree import Block
from terrainwave.progress import Progress

REPOSITORY = Path(__file__).parent.parent.parent
HOSTILE = "<script>alert(1)</script>\x1b]8;;http://x\x07[link=http://x]z[/link]\u202e\nnext"

TARGETS = {"compress": "out.twz", "decompress": "out.tif"}


@pytest.fixture
def dem(tmp_path):
    heights = terrain_like(150, 140)
    heights[5:9, 30:40] = -32768
    return write_geotiff(
        tmp_path / "dem.tif",
        heights,
        nodata=-32768,
        crs="EPSG:32611",
        transform=Affine(30, 0, 4e5, 0, -30, 4e6),
        units=("m",),
    )


@pytest.fixture
def twz(tmp_path, dem):
    path = tmp_path / "dem.twz"
    terrainwave.compress(dem, path, max_error=1, method="store", block=32)
    return path


def test_compress_verify_decompress_info_work_together(tmp_path, dem):
    twz, back = tmp_path / "out.twz", tmp_path / "back.tif"
    done = run("compress", dem, twz, "--max-error", 1, "--method", "store", "--block", 32)
    assert done.exit_code == 0, done.output
    assert "bits/sample" in done.stdout
    assert "asked 1, guaranteed 1, measured 1 m" in done.stdout
    done = run("verify", twz, dem)
    assert (done.exit_code, done.stdout.splitlines()[-1]) == (0, "ok")
    done = run("decompress", twz, back)
    assert done.exit_code == 0, done.output
    original, valid, profile = read_geotiff(dem)
    heights, back_valid, back_profile = read_geotiff(back)
    np.testing.assert_array_equal(back_valid, valid)
    assert np.abs(heights[valid].astype(int) - original[valid]).max() == 1
    for name in ("nodata", "crs", "transform", "dtype"):
        assert back_profile[name] == profile[name]
    done = run("info", twz)
    assert done.exit_code == 0
    assert "150 rows x 140 columns, int16" in done.stdout
    assert "EPSG:32611" in done.stdout


def test_nothing_but_the_result_is_printed_in_a_pipe(tmp_path, dem):
    process = start("compress", dem, tmp_path / "a.twz", "--max-error", 2, "--method", "store")
    stdout, stderr = process.communicate(timeout=300)
    assert process.returncode == 0, stderr
    assert "\x1b" not in stdout + stderr
    assert len(stdout.splitlines()) == 2
    assert all(line.startswith("compiling kernels") for line in stderr.splitlines())


def test_compress_prints_json(tmp_path, dem):
    target = tmp_path / "a.twz"
    done = run("compress", dem, target, "--max-error", 2.5, "--method", "store", "--json")
    fields = json.loads(done.stdout)
    assert fields["n_bytes"] == target.stat().st_size
    assert (fields["max_error"], fields["effective_error"]) == (2.5, 2)
    assert fields["method"] == "store"


def test_decompress_prints_json(tmp_path, twz):
    done = run("decompress", twz, tmp_path / "a.tif", "--json")
    n_bytes = (tmp_path / "a.tif").stat().st_size
    expected = {"path": str(tmp_path / "a.tif"), "n_bytes": n_bytes, "notes": []}
    assert json.loads(done.stdout) == expected
    done = run("decompress", twz, "--to", tmp_path / "all", "--json")
    found = json.loads(done.stdout)
    target = tmp_path / "all" / "dem.tif"
    assert (found["status"], found["path"]) == ("decompressed", str(target))
    assert found["n_bytes"] == target.stat().st_size


def test_decompress_window_bounds_and_level(tmp_path, twz):
    with terrainwave.open(twz) as terrain:
        whole, half = terrain.read(), terrain.read(level=-2)
    window, bounds, level = (tmp_path / f"{name}.tif" for name in ("window", "bounds", "level"))
    assert run("decompress", twz, window, "--window", "10,20,30,40").exit_code == 0
    np.testing.assert_array_equal(read_geotiff(window)[0], whole[10:40, 20:60])
    box = f"{4e5 + 20 * 30},{4e6 - 40 * 30},{4e5 + 60 * 30},{4e6 - 10 * 30}"
    assert run("decompress", twz, bounds, "--bounds", box).exit_code == 0
    np.testing.assert_array_equal(read_geotiff(bounds)[0], whole[10:40, 20:60])
    assert read_geotiff(bounds)[2]["transform"] == Affine(30, 0, 4e5 + 600, 0, -30, 4e6 - 300)
    assert run("decompress", twz, level, "--level", -2).exit_code == 0
    np.testing.assert_array_equal(read_geotiff(level)[0], half)


def test_info_json_is_complete(twz):
    fields = json.loads(run("info", twz, "--json", "--errors", "measured").stdout)
    assert (fields["n_rows"], fields["n_cols"]) == (150, 140)
    assert (fields["max_error"], fields["units"]) == (1, "m")
    assert fields["crs"] == "EPSG:32611"
    assert len(fields["level_errors"]) == fields["n_levels"]


def test_verify_exits_1_where_a_height_is_beyond_the_bound(dem, twz):
    done = run("verify", twz, dem, "--max-error", 0.5)
    assert done.exit_code == 1
    assert "further from the original than 0.5" in done.stdout
    assert done.stdout.splitlines()[-1] == "not ok"


def test_verify_prints_json(dem, twz):
    done = run("verify", twz, dem, "--json")
    fields = json.loads(done.stdout)
    assert done.exit_code == 0
    assert fields["ok"] is True
    assert fields["errors"]["max_error"] == 1
    done = run("verify", twz, dem, "--json", "--max-error", 0)
    assert (done.exit_code, json.loads(done.stdout)["ok"]) == (1, False)


def test_infinite_numbers_are_strings_in_json(tmp_path):
    heights = terrain_like(40, 40, "float32")
    heights[0, 0] = np.inf
    path = write_geotiff(tmp_path / "a.tif", heights)
    target = tmp_path / "a.twz"
    options = ["--nodata", "inf", "--max-error", 1, "--method", "store"]
    assert run("compress", path, target, *options).exit_code == 0
    assert json.loads(run("info", target, "--json").stdout)["nodata"] == "inf"
    done = run("verify", target, path, "--json")  # --nodata is not given: valid and infinite
    assert done.exit_code == 1
    assert json.loads(done.stdout)["ok"] is False
    assert run("verify", target, path, "--nodata", "inf").exit_code == 0


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names themselves")
def test_a_name_that_is_no_text_is_one_line(tmp_path, dem, twz):
    name = tmp_path / os.fsdecode(b"a\xff.tif")
    name.write_bytes(dem.read_bytes())
    for command, source, target in (
        ("compress", name, tmp_path / "b.twz"),
        ("verify", twz, name),
        ("decompress", twz, tmp_path / os.fsdecode(b"b\xff.tif")),
    ):
        assert "UTF-8" in one_line(run(command, source, target), 1)
    assert sorted(os.listdir(tmp_path)) == sorted(["dem.tif", "dem.twz", name.name])


def test_existing_target_is_refused(dem, twz):
    before = twz.read_bytes()
    line = one_line(run("compress", dem, twz, "--method", "store"), 1)
    assert "already exists" in line
    assert "--overwrite" in line
    assert twz.read_bytes() == before
    assert run("compress", dem, twz, "--method", "store", "--overwrite", "-q").exit_code == 0
    assert twz.read_bytes() != before


@pytest.mark.parametrize("command", ["compress", "decompress"])
@pytest.mark.parametrize("by_link", [False, True])
def test_a_target_that_is_the_source_is_refused(tmp_path, dem, twz, command, by_link):
    source = dem if command == "compress" else twz
    before = source.read_bytes()
    target = tmp_path / TARGETS[command]
    (os.symlink if by_link else os.link)(source, target)
    assert "expected another name" in one_line(run(command, source, target, "--overwrite"), 1)
    assert source.read_bytes() == before


@pytest.mark.parametrize("scale", [np.nan, np.inf, 0.0, 1e-305])
def test_a_scale_that_gives_no_heights_is_one_line(tmp_path, scale):
    source = write_geotiff(tmp_path / "a.tif", terrain_like(9, 9), bands={"scales": scale})
    line = one_line(run("compress", source, tmp_path / "a.twz", "--max-error", "1e9"), 1)
    assert "scale is" in line
    assert os.listdir(tmp_path) == ["a.tif"]


@pytest.mark.full
@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
@pytest.mark.parametrize(
    ("name", "status", "word"),
    [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated"), ("SIGHUP", 129, "terminated")],
)
def test_a_signal_leaves_the_target_and_nothing_else(tmp_path, name, status, word):
    rng = np.random.default_rng(0)
    source = write_geotiff(tmp_path / "a.tif", rng.integers(0, 9999, (1500, 1500)).astype("int16"))
    target = tmp_path / "a.twz"
    target.write_bytes(b"mine")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    process = start(
        "compress", source, target, "--overwrite", "--max-error", 1, "--temp-dir", temporary
    )
    while not os.listdir(temporary):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(getattr(signal, name))
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == status, stderr
    assert stderr.splitlines()[-1] == f"terrainwave: {word}; the target is untouched"
    assert target.read_bytes() == b"mine"
    assert sorted(os.listdir(tmp_path)) == ["a.tif", "a.twz", "temporary"]
    assert os.listdir(temporary) == []


@pytest.fixture
def usual_signals():
    """Let SIGTERM end the process, as where no test runs."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    for number in before:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def ended_twice():
    try:
        interrupts.check()
    finally:
        signal.raise_signal(signal.SIGTERM)
        interrupts.check()


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals")
def test_signals_that_are_ignored_stay_so_and_a_second_one_does_not_stop_the_clearing_up(
    usual_signals,
):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ending_by_signals():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            signal.raise_signal(signal.SIGTERM)
            with pytest.raises(Terminated) as ended:
                ended_twice()
            assert ended.value.status == 143
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_waits_until_no_work_is_half_done(usual_signals, name):
    lock = threading.Lock()
    with ending_by_signals():
        lock.acquire()
        os.kill(os.getpid(), getattr(signal, name))
        time.sleep(0.05)
        lock.release()  # never reached if the signal is raised at once
        with pytest.raises(Terminated):
            interrupts.check()
    assert not interrupts.is_requested()


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
def test_a_signal_ends_what_waits_for_long(usual_signals, monkeypatch):
    monkeypatch.setattr(signals, "_PATIENCE", 0.05)

    def wait_for_long():
        with ending_by_signals():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)

    start = time.monotonic()
    with pytest.raises(Terminated):
        wait_for_long()
    assert time.monotonic() - start < 30


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
def test_a_signal_never_ends_what_numba_is_at(usual_signals, monkeypatch):
    monkeypatch.setattr(signals, "_PATIENCE", 0.01)
    namespace = {"__name__": "numba.core.compiler_lock", "time": time}
    exec("def acquire():\n    time.sleep(0.3)\n    return True", namespace)
    with ending_by_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        assert namespace["acquire"]()
        with pytest.raises(Terminated):
            interrupts.check()


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
def test_a_signal_that_other_code_drops_is_raised_again(usual_signals, monkeypatch):
    """Toolkits have bare excepts, and calls from C where nothing can be raised."""
    monkeypatch.setattr(signals, "_PATIENCE", 0.05)

    def dropping():
        with contextlib.suppress(BaseException):
            time.sleep(60)

    with ending_by_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        dropping()
        with pytest.raises(Terminated):
            time.sleep(60)
        with pytest.raises(Terminated):
            interrupts.check()


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
def test_the_handler_of_a_signal_starts_no_thread(usual_signals):
    """The main thread may hold a lock that every new thread takes."""
    with ending_by_signals():
        before = threading.enumerate()
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupts.is_requested()
        assert threading.enumerate() == before


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
def test_no_signal_comes_between_a_file_and_its_name(usual_signals, monkeypatch):
    monkeypatch.setattr(signals, "_PATIENCE", 0.01)
    with ending_by_signals():
        with interrupts.publishing("a.twz"):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.3)
        assert interrupts.complete() == ["a.twz"]
        with pytest.raises(Terminated):
            interrupts.check()


@pytest.mark.full
@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_after_the_end_of_a_command_changes_nothing(tmp_path, dem, name):
    program = f"""
import atexit, os, signal, sys
from terrainwave.cli import main
atexit.register(lambda: os.kill(os.getpid(), signal.{name}))
sys.argv[1:] = ["compress", {str(dem)!r}, "a.twz", "--quiet"]
main()
"""
    done = python(program, cwd=tmp_path)
    assert (done.returncode, done.stderr.replace("compiling", "")) == (0, "")
    assert run("verify", tmp_path / "a.twz", dem).exit_code == 0


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one process only")
def test_a_signal_before_the_naming_of_a_file_leaves_the_target(
    usual_signals, monkeypatch, tmp_path, dem
):
    monkeypatch.setattr("os.fsync", lambda _: os.kill(os.getpid(), signal.SIGTERM))
    done = run("compress", dem, tmp_path / "a.twz", "-q")
    assert done.exit_code == 143
    assert done.stderr.strip() == "terrainwave: terminated; the target is untouched"
    assert not (tmp_path / "a.twz").exists()


def test_control_characters_are_taken_out():
    assert plain(HOSTILE) == "<script>alert(1)</script>]8;;http://x[link=http://x]z[/link] next"


def test_hostile_strings_in_a_file_reach_the_terminal_as_plain_text(tmp_path):
    hostile = HOSTILE.replace("\n", " ")
    path = write_geotiff(
        tmp_path / "a.tif", terrain_like(40, 40), units=(hostile,), bands={"descriptions": hostile}
    )
    target = tmp_path / "a.twz"
    done = run("compress", path, target, "--method", "store")
    shown = run("info", target)
    assert (done.exit_code, shown.exit_code) == (0, 0), done.output
    for text in (done.output, shown.output):
        assert "\x1b" not in text
        assert "\x07" not in text
        assert "\u202e" not in text
    assert "[link=http://x]" in shown.output.replace("\n", "")


def test_progress_bar_is_drawn_on_a_terminal_only(monkeypatch):
    class Terminal:
        def isatty(self):
            return True

        def __getattr__(self, name):
            return getattr(sys.__stderr__, name)

    assert Bar()._bar is None
    monkeypatch.setattr(cli_output.sys, "stderr", Terminal())
    assert Bar(quiet=True)._bar is None
    bar = Bar()
    assert bar._bar is not None
    bar._bar.console.file = open(os.devnull, "w", encoding="utf-8")
    with bar:
        bar(Progress("scanning", 5, 10))
        bar(Progress("encoding", 3, 9, n_bytes_in=1000, n_bytes_out=100))
    task = bar._bar.tasks[0]
    assert (task.description, task.completed, task.total) == ("encoding", 3, 9)
    assert task.fields["ratio"] == "10.0:1"
    bar._bar.console.file.close()


def completed(*words):
    """Return (type, value) of what bash is told for the last word."""
    from click.shell_completion import get_completion_class

    *before, last = words
    found = get_completion_class("bash")(main, {}, "terrainwave", "_X").get_completions(
        before, last
    )
    return [(item.type, item.value) for item in found]


def test_completion_knows_commands_options_and_values():
    assert completed("comp") == [("plain", "compress")]
    assert completed("compress", "--skip") == [("plain", "--skip-existing")]
    assert ("plain", "predictive") in completed("compress", "--method", "p")


@pytest.mark.full
@pytest.mark.skipif(sys.platform == "win32", reason="no bash")
def test_the_documented_line_completes_in_bash():
    page = (REPOSITORY / "docs" / "command-line.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"`(eval .*bash_source.*)` \|", page)
    script = f"""{line}
COMP_WORDS=(terrainwave render --mode vert) COMP_CWORD=3
_terrainwave_completion terrainwave vert --mode
echo "${{COMPREPLY[@]}}"; complete -p terrainwave"""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, check=True,
        env={**os.environ, "PATH": path},
    )  # fmt: skip
    assert done.stdout.splitlines()[0] == "vertex-texture"
    assert "-F _terrainwave_completion terrainwave" in done.stdout


@pytest.mark.parametrize("args", [["--help"], ["--version"], ["compress", "--help"]])
def test_help_imports_neither_numba_nor_rasterio(args):
    program = f"""
import sys
from terrainwave.cli import main
try:
    main({args!r}, prog_name="terrainwave")
except SystemExit as end:
    loaded = [name for name in ("numba", "rasterio", "numpy", "rich") if name in sys.modules]
    sys.exit(end.code or (str(loaded) if loaded else 0))
"""
    done = python(program)
    assert done.returncode == 0, done.stderr
    assert "terrainwave" in done.stdout


@pytest.mark.full
def test_demo_checks_and_draws(tmp_path):
    done = run("demo", tmp_path / "demo")
    assert done.exit_code == 0, done.output
    assert sorted(os.listdir(tmp_path / "demo")) == [
        "demo.png",
        "jacksboro.tif",
        "jacksboro_0m.twz",
        "jacksboro_10m.twz",
        "jacksboro_1m.twz",
        "jacksboro_3m.twz",
    ]
    assert "344 x 403 heights" in done.stdout
    assert (tmp_path / "demo" / "demo.png").read_bytes()[:4] == b"\x89PNG"
    # Again, over its own files.
    assert run("demo", tmp_path / "demo", "--quiet").output == ""


@pytest.mark.parametrize("had_run", [False, True])
@pytest.mark.parametrize("failure", [StorageError("the disk is full"), KeyboardInterrupt()])
def test_a_demo_that_fails_leaves_nothing(tmp_path, monkeypatch, had_run, failure):
    directory = tmp_path / "new" / "demo"
    if had_run:
        directory.mkdir(parents=True)
        (directory / "demo.png").write_bytes(b"of an earlier run")
    monkeypatch.setattr(terrainwave, "compress", Mock(side_effect=failure), raising=False)
    result = run("demo", directory)
    assert result.exit_code == (1 if isinstance(failure, StorageError) else 130)
    if had_run:
        assert os.listdir(directory) == ["demo.png"]
        assert (directory / "demo.png").read_bytes() == b"of an earlier run"
    else:
        assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("method", [terrainwave.Cdf97(faithful=True), "rapid"], ids=str)
def test_recursive_errors_are_those_of_equations_2_and_3(tmp_path, method):
    """Against `reference.recursive_errors`, in heights of half metres."""
    target, bound = tmp_path / "a.twz", 3
    heights = (0.5 * terrain_like(129, 129)).astype(np.float32)
    options = {"method": method, "mesh": "zerotree", "block": 32}
    terrainwave.compress(heights, target, max_error=bound, **options)
    with terrainwave.open(target) as terrain:
        levels = [terrain.read(level=level) for level in range(terrain.n_levels)]
        quanta = [(2 * level).astype(np.int64) for level in levels]
        heights_errors, sums = [], []
        for level, errors in enumerate(recursive_errors(quanta, 32, 2 * bound)):
            above = terrain.n_levels - 1 - level
            heights_errors.append(float(max(errors.values())) / 2)
            # Err_Tri of section 2.6: a quarter is of the error that the index holds, rounded up.
            own = {place: terrain.block_error(Block(level, *place)) for place in errors}
            sums.append(
                max(
                    float(error) / 2 + max(bound * 2**above, own[place] / 4 if above else 0)
                    for place, error in errors.items()
                )
            )
    fields = json.loads(run("info", target, "--json", "--errors", "recursive").stdout)
    assert fields["level_errors"] == heights_errors
    assert fields["level_mesh_errors"] == sums
    last = run("info", target, "--errors", "recursive").stdout.splitlines()[-1]
    assert last.split()[-2:] == ["3", "6"]


def test_program_that_asks_for_lines_is_told_each_percent_once(monkeypatch, capsys):
    monkeypatch.setenv("TERRAINWAVE_PROGRESS", "lines")
    bar, quiet = Bar(), Bar(quiet=True)
    for done in (0, 1, 503, 509, 1000):
        bar(Progress("encoding", done, 1000))
        quiet(Progress("encoding", done, 1000))
    assert capsys.readouterr().err.splitlines() == [
        f"progress: encoding {percent} %" for percent in (0, 50, 100)
    ]


def test_info_says_how_voids_are_told_and_counts_them(tmp_path):
    heights = terrain_like(40, 70)
    heights[3:5, 60:70] = -9
    path = write_geotiff(tmp_path / "a.tif", heights, nodata=-9)
    target = tmp_path / "a.twz"
    run("compress", path, target, "--method", "store", "--block", "32")
    assert "marked by the value -9" in run("info", target).stdout
    assert "20 samples, 0.007143 of all" in run("info", target, "--voids").stdout
    assert json.loads(run("info", target, "--json", "--voids").stdout)["n_voids"] == 20
