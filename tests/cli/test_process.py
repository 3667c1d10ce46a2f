"""What a process may lack: streams, an encoding, room, rights; and what fails below a command."""

import errno
import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from contextlib import contextmanager
from fnmatch import fnmatch
from unittest.mock import Mock

import numpy as np
import pytest
from affine import Affine
from commands import environment, one_line, python, run
from numba.core.errors import LoweringError, NumbaError, TypingError
from rasterio._err import CPLE_AppDefinedError
from rasterio.errors import RasterioError, RasterioIOError
from strategies import terrain_like, write_geotiff

import terrainwave

OPTIONS = {"max_error": 1, "method": "store", "block": 32}
QUICK = ["--method", "store", "--block", 32, "--max-error", 1]
PROGRAM = "import sys; from terrainwave.cli import main; main(prog_name='terrainwave')"


@pytest.fixture
def dem(tmp_path):
    return write_geotiff(
        tmp_path / "dem.tif",
        terrain_like(40, 36),
        crs="EPSG:32633",
        transform=Affine(30, 0, 500_000, 0, -30, 5_000_000),
    )


@pytest.fixture
def twz(tmp_path, dem):
    terrainwave.compress(dem, tmp_path / "dem.twz", **OPTIONS)
    return tmp_path / "dem.twz"


def in_shell(redirections, *args, **variables):
    """Run a command in a process of its own, by a shell that redirects its streams."""
    command = shlex.join([sys.executable, "-c", PROGRAM, *map(str, args)])
    return subprocess.run(
        ["sh", "-c", f"{command} {redirections}"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        encoding="utf-8",
        errors="replace",
        timeout=300,
        env=environment(**variables),
    )


needs_shell = pytest.mark.skipif(sys.platform == "win32", reason="no sh")


COMMANDS = [
    ["info", "dem.twz"],
    ["compress", "dem.tif", "new.twz", *QUICK],
    ["compress", "dem.tif", "--to", "out", *QUICK],
    ["decompress", "dem.twz", "new.tif"],
    ["mesh", "dem.twz", "new.ply"],
    ["info", "dem.twz", "--json"],
    ["verify", "dem.twz", "dem.tif"],
    ["publish", "dem.twz", "site"],
    ["site", "page"],
    ["tiles", "dem.twz", "tiles"],
]


@pytest.mark.few(1)
@needs_shell
@pytest.mark.parametrize(
    ("streams", "command"),
    [
        *(("0>&- 1>&- 2>&-", command) for command in COMMANDS),
        *(("2>&-", command) for command in COMMANDS[1::4]),
        *(("1>&- 2>&-", command) for command in COMMANDS[::4]),
    ],
    ids=lambda found: (
        found if isinstance(found, str) else "_".join(map(str, [found[0], *found[2:3]]))
    ),
)
def test_commands_do_their_work_with_closed_streams(tmp_path, dem, twz, streams, command):
    paths = [tmp_path / name if "." in str(name) else name for name in command[1:]]
    paths = [
        tmp_path / name if name in ("out", "site", "page", "tiles") else name for name in paths
    ]
    plain = run(command[0], *paths)
    made = [path for path in tmp_path.iterdir() if path.name not in ("dem.tif", "dem.twz")]
    for path in made:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    done = in_shell(streams, command[0], *paths)
    assert (done.returncode, done.stderr) == (plain.exit_code, "")
    assert done.stdout == (plain.stdout if "1>" not in streams else "")
    after = sorted(path.name for path in tmp_path.iterdir())
    assert after == sorted([*(path.name for path in made), "dem.tif", "dem.twz"])


@needs_shell
def test_a_failure_without_stderr_has_its_status(tmp_path):
    assert in_shell("2>&-", "info", tmp_path / "none.twz").returncode == 1
    assert in_shell("2>&-", "info").returncode == 2


@pytest.mark.full
@needs_shell
def test_what_libraries_print_goes_into_no_file(tmp_path, dem):
    """The first file that is opened would be stderr to GDAL, numba and the C library."""
    program = f"""
import os, sys
from terrainwave.cli import main
from terrainwave.cli.streams import prepare_streams
prepare_streams()
import terrainwave.write.compress as module
assemble = module.assemble
def printing(*arguments):
    os.write(2, b"a library's warning")
    os.write(1, b"a library's words")
    return assemble(*arguments)
module.assemble = printing
main(["compress", {str(dem)!r}, {str(tmp_path / "new.twz")!r}, "--quiet"])
"""
    (tmp_path / "program.py").write_text(program)
    command = f"{sys.executable} {tmp_path / 'program.py'} 0<&- 1>&- 2>&-"
    assert subprocess.run(["sh", "-c", command], env=environment(), timeout=300).returncode == 0
    data = (tmp_path / "new.twz").read_bytes()
    assert b"library" not in data
    assert run("verify", tmp_path / "new.twz", dem).exit_code == 0


@pytest.mark.full
@needs_shell
def test_a_file_cannot_go_to_a_closed_stdout_or_come_from_a_closed_stdin(tmp_path, dem, twz):
    for done, words in (
        (in_shell(">&-", "compress", dem, "-", *QUICK), "cannot write stdout: it is closed"),
        (in_shell(">&-", "decompress", twz, "-"), "cannot write stdout: it is closed"),
        (in_shell("<&-", "compress", "-", tmp_path / "a.twz"), "cannot read stdin: it is closed"),
        (in_shell("<&-", "info", "-"), "cannot read stdin: it is closed"),
    ):
        assert (done.returncode, done.stdout) == (1, "")
        (line,) = done.stderr.splitlines()
        assert line.startswith(f"terrainwave: {words}; expected")


@needs_shell
@pytest.mark.full
def test_names_and_units_of_any_letters_are_printed_in_any_encoding(tmp_path):
    import rasterio

    path = tmp_path / "høyde 高.tif"
    write_geotiff(path, terrain_like(40, 36))
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ["mètres ↑"]
        dataset.update_tags(SOURCE="Ærø – 測量")
    target = tmp_path / "高.twz"
    for command in (
        ["compress", path, target, *QUICK],
        ["info", target],
        ["info", target, "--json"],
        ["info", target, "--levels"],
        ["decompress", target, tmp_path / "тест.tif"],
        ["decompress", target, tmp_path / "тест.tif"],
    ):
        done = in_shell("", *command, PYTHONIOENCODING="ascii", PYTHONUTF8="0")
        if command[1] != "--levels" and "--levels" not in command:
            is_second = command[0] == "decompress" and "already exists" in done.stderr
            assert done.returncode == int(is_second), done.stderr
        assert "Traceback" not in done.stderr
        assert "unexpected" not in done.stderr
        if "--json" in command:
            assert json.loads(done.stdout)["units"] == "mètres ↑"


def test_an_error_of_a_file_does_not_name_stdout(tmp_path, dem, monkeypatch):
    monkeypatch.setattr(
        "terrainwave.write.compress.assemble",
        Mock(side_effect=OSError(errno.ENOSPC, "No space left on device", "/somewhere/else")),
    )
    line = one_line(run("compress", dem, tmp_path / "a.twz", *QUICK), 1)
    assert "stdout" not in line
    assert "/somewhere/else: No space left on device" in line


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("command", "unbuffered"),
    [("compress", ""), ("decompress", "1"), ("info", "1"), ("verify", "")],
)
def test_a_full_stdout_is_named(dem, twz, command, unbuffered):
    target = ["-"] * (command in ("compress", "decompress"))
    source = dem if command == "compress" else twz
    done = in_shell(">/dev/full", command, source, *target, PYTHONUNBUFFERED=unbuffered)
    assert done.returncode == 1
    lines = [line for line in done.stderr.splitlines() if line.startswith("terrainwave")]
    assert lines == ["terrainwave: cannot write stdout: the disk is full"]


PRINTING = """
from terrainwave.cli import main
from terrainwave.cli.output import Command
@main.command(cls=Command)
def words():
    print("words", end="", flush=True)
main(["words"])
"""


def printed_to(stdout):
    """Return stderr of a command whose work prints, with a stdout that takes nothing."""
    done = python(PRINTING, stdout=stdout, stderr=subprocess.PIPE, capture_output=False)
    assert done.returncode == 1
    return done.stderr


@contextmanager
def full_pipe():
    """Yield the ends of a full pipe that does not wait: a descriptor to read, a file to write."""
    reader, writer = os.pipe()
    with open(reader, "rb"), open(writer, "wb", buffering=0) as pipe:
        os.set_blocking(writer, False)
        while pipe.write(bytes(1 << 16)):
            pass
        yield reader, pipe


@needs_shell
def test_a_stdout_that_does_not_wait_is_named_and_one_that_nobody_reads_is_not():
    with full_pipe() as (_, pipe):
        told = printed_to(pipe)
    assert told == f"terrainwave: cannot write stdout: {os.strerror(errno.EAGAIN)}\n"
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb") as pipe:
        assert printed_to(pipe) == ""


# A program that may write files of few bytes only, as on a disk that is nearly full.
LITTLE_ROOM = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)), resource.RLIM_INFINITY))
from terrainwave.cli import main
main(prog_name="terrainwave")
"""


@needs_shell
@pytest.mark.full
@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("compress big.tif new.twz --method store", "temporary files in *.new.twz.*"),
        ("compress big.tif new.twz --method store --temp-dir TEMPORARY", "temporary files in *"),
        ("patch big.twz part.tif", "*"),
        ("mesh big.twz new.twz --store", "*new.twz"),
        ("mesh big.twz new.ply", "new.ply"),
        ("decompress big.twz new.tif --threads 1", "new.tif"),
        ("decompress big.twz new.tif --threads 2", "new.tif"),
        ("decompress big.twz new.tif --cog", "new.tif"),
        ("decompress big.twz new.r16", "new.r16"),
        ("decompress big.twz new.png", "new.png"),
        pytest.param("render big.twz new.png --size 900x900", "new.png", marks=pytest.mark.gl),
    ],
)
def test_lack_of_room_is_one_line_with_a_name(tmp_path, command, name):
    side = 1200 if command.startswith("compress") else 300  # over a mebibyte: in temporary files
    heights = np.random.default_rng(0).integers(0, 300, (side, side)).astype("int16")
    place = {"crs": "EPSG:32633", "transform": Affine(30, 0, 500_000, 0, -30, 5_000_000)}
    write_geotiff(tmp_path / "big.tif", heights, **place)
    write_geotiff(tmp_path / "part.tif", heights[:150][::-1], **place)
    terrainwave.compress(tmp_path / "big.tif", tmp_path / "big.twz", max_error=1)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    words = command.replace("TEMPORARY", str(tmp_path)).split()
    done = python(LITTLE_ROOM, 20000, *words, "-q", cwd=tmp_path)
    assert done.returncode == 1
    # Kernels that are compiled here find no room either.
    kept = "note: compiled kernels are not kept"
    (line,) = (line for line in done.stderr.splitlines() if not line.startswith(kept))
    assert fnmatch(line, f"terrainwave: cannot write {name}: File too large")
    assert not re.search(r"cannot write \d+:", line)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.few(3)
@pytest.mark.parametrize("n_bytes", [228, 229, 253, 255])
@pytest.mark.parametrize("letter", ["a", "高"])
def test_names_may_be_as_long_as_the_system_takes(tmp_path, dem, n_bytes, letter):
    def name(ending):
        room = n_bytes - len(ending)
        width = len(letter.encode())
        return tmp_path / (letter * (room // width) + "x" * (room % width) + ending)

    try:
        name(".twz").touch()
        name(".twz").unlink()
    except OSError:
        pytest.skip("this file system takes no name of that length")
    for command in (
        ["compress", dem, name(".twz"), *QUICK],
        ["compress", dem, name(".twz"), *QUICK, "--overwrite"],
        ["decompress", name(".twz"), name(".tif")],
        ["decompress", name(".twz"), name("cog.tif"), "--cog"],
        ["mesh", name(".twz"), name(".ply")],
        ["verify", name(".twz"), dem],
        ["publish", name(".twz"), tmp_path / "site"],
    ):
        done = run(*command)
        assert done.exit_code == 0, (command[0], done.stderr)
        assert not [found for found in os.listdir(tmp_path) if found.startswith(".")]


def test_what_a_killed_run_left_beside_a_long_name_is_removed(tmp_path):
    from terrainwave.container.targets.publication import publish, scratch_directory

    first, second = (tmp_path / ("a" * 240 + end) for end in ("1.twz", "2.twz"))
    with publish(first) as part, scratch_directory(tmp_path, first.name) as scratch:
        left = tmp_path / part.path.name.replace(part.path.name.split(".")[-2], "0" * 16)
        left.touch()
        lock = scratch.with_name(scratch.name.replace(scratch.name.split(".")[-2], "1" * 16))
        lock = lock.with_suffix(".twz-lock")
        lock.touch()
    with publish(second), scratch_directory(tmp_path, second.name):
        assert left.exists()
        assert lock.exists()
    with publish(first, overwrite=True), scratch_directory(tmp_path, first.name):
        assert not left.exists()
        assert not lock.exists()


@needs_shell
def test_what_is_published_has_the_modes_of_the_umask(tmp_path, twz, monkeypatch):
    from terrainwave.ext import publish

    package = tmp_path / "package"
    shutil.copytree(publish._STATIC, package / "static")
    for name in publish._READER:
        shutil.copytree(publish.reader_directory() / name, package / "js" / name)
    shutil.copy(publish.reader_directory() / "LICENSE", package / "js" / "LICENSE")
    for path in [package, *package.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    monkeypatch.setattr(publish, "_STATIC", package / "static")
    monkeypatch.setattr(publish, "reader_directory", lambda: package / "js")
    before = os.umask(0o027)
    try:
        done = run("publish", twz, tmp_path / "site")
    finally:
        os.umask(before)
    assert done.exit_code == 0, done.stderr
    made = [path for path in (tmp_path / "site").rglob("*") if path.name != "site"]
    assert len(made) > 10
    for path in made:
        expected = 0o750 if path.is_dir() else 0o640
        assert stat.S_IMODE(path.stat().st_mode) == expected, path
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


ERRORS = {
    "full": lambda: OSError(errno.ENOSPC, "No space left on device"),
    "full_named": lambda: OSError(errno.ENOSPC, "No space left on device", "/x/y"),
    "io": lambda: OSError(errno.EIO, "Input/output error"),
    "too_many": lambda: OSError(errno.EMFILE, "Too many open files", "/x/y"),
    "bare": OSError,
    "permission": lambda: PermissionError(errno.EACCES, "Permission denied", b"/x/y"),
    "missing": lambda: FileNotFoundError(errno.ENOENT, "No such file or directory", "/x/y"),
    "reset": lambda: ConnectionResetError(errno.ECONNRESET, "Connection reset by peer"),
    "pipe": lambda: BrokenPipeError(errno.EPIPE, "Broken pipe"),
    "late": lambda: TimeoutError("timed out"),
    "memory": MemoryError,
    "rasterio": lambda: RasterioError("GDAL\nsays no"),
    "rasterio_io": lambda: RasterioIOError("Read failed"),
    "cpl": lambda: CPLE_AppDefinedError(1, 2, "an error of GDAL"),
    "numba": lambda: NumbaError("no\nidea"),
    "typing": lambda: TypingError("Failed in nopython mode pipeline"),
    "lowering": lambda: LoweringError("Failed to lower"),
    "unicode": lambda: UnicodeEncodeError("ascii", "é", 0, 1, "ordinal not in range"),
    "key": lambda: KeyError("x"),
    "runtime": lambda: RuntimeError("[/link] \x1b[31m two\nlines"),
    "index": IndexError,
    "recursion": RecursionError,
    "system": lambda: SystemError("returned a result with an exception set"),
}
LAYERS = {
    "compress": [
        "raster_io.source.RasterSource.read",
        "raster_io.dataset.DatasetBackend.__init__",
        "grid.quantum.HeightScan.update",
        "grid.quantum.HeightScan.quantizer",
        "write.pyramid.Pyramid.build",
        "write.encoder.TreeEncoder.run",
        "mesh.blocks.measure_meshes",
        "container.writer.SpoolSink.__init__",
        "write.compress.assemble",
        "write.passes.proof.Comparison.window",
        "container.reader.Container.__init__",
    ],
    "decompress": [
        "container.reader.Container.__init__",
        "container.reader.Container.payloads",
        "read.decoder.TreeDecoder.unit",
        "grid.quantum.Quantizer.dequantize",
    ],
    "info": [
        "container.reader.Container.__init__",
        "raster_io.raster_info.RasterInfo.from_metadata",
    ],
    "verify": ["verification.heights.opened", "read.decoder.TreeDecoder.unit"],
    "mesh": ["container.reader.Container.payloads", "export.mesh.Mesh.save"],
}


def commands_and_errors():
    """Yield each error of the first layer, and two errors of each other one."""
    layers = [(name, layer) for name, layers in LAYERS.items() for layer in layers]
    kinds = [*ERRORS]
    for number, layer in enumerate(layers):
        some = kinds if not number else (kinds[2 * number % len(kinds)], kinds[-number])
        yield from ((*layer, error) for error in some)


@pytest.mark.few(16)
@pytest.mark.parametrize(("command", "layer", "error"), [*commands_and_errors()])
def test_whatever_a_layer_raises_is_one_line_and_status_1(
    tmp_path, dem, twz, monkeypatch, command, layer, error
):
    raised = []

    def raising(*_, **__):
        raised.append(layer)
        raise ERRORS[error]()

    before = sorted(os.listdir(tmp_path))
    monkeypatch.setattr(f"terrainwave.{layer}", raising)
    arguments = {
        "compress": [dem, tmp_path / "new.twz", *QUICK, "--measure-meshes"],
        "decompress": [twz, tmp_path / "new.tif"],
        "info": [twz],
        "verify": [twz, dem],
        "mesh": [twz, tmp_path / "new.ply"],
    }
    line = one_line(run(command, *arguments[command]), 1)
    assert raised
    assert "stdout" not in line
    assert len(line) > len("terrainwave: ")
    assert "\x1b" not in line
    if error.endswith(("named", "many", "permission", "missing")):
        assert "/x/y" in line or str(tmp_path) in line
    assert sorted(os.listdir(tmp_path)) == before


def test_a_defect_shows_its_traceback_to_who_asks(twz, monkeypatch, capfd):
    monkeypatch.setattr(
        "terrainwave.container.reader.Container.__init__", Mock(side_effect=KeyError("x"))
    )
    assert "TERRAINWAVE_TRACEBACK=1" in one_line(run("info", twz), 1)
    monkeypatch.setenv("TERRAINWAVE_TRACEBACK", "1")
    done = run("info", twz)
    assert done.exit_code == 1
    assert "Traceback" in done.stderr
    assert "in info" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("terrainwave: unexpected KeyError")
