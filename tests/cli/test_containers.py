"""Images and shared machines: does what docs/how-to/containers.md says hold for other users?"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from strangers import as_stranger, forbid_writing, own_folder, visible_folder
from strategies import write_geotiff

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "how-to" / "containers.md").read_text(encoding="utf-8")

pytestmark = [
    pytest.mark.large,  # plain Python keeps no kernels
    pytest.mark.skipif(sys.platform == "win32", reason="no modes of folders there"),
]

COMPRESS = (
    "compress", "dem.tif", "dem.twz", "--max-error", "0", "--method", "store", "--no-mesh",
    "--overwrite",
)  # fmt: skip
# `warmup` of the image compiles what the page's commands need; test_warmup.py runs all of it.
FEWER_KERNELS = """
SUPPORTED_DTYPES, METHODS = ("float32",), {DEFAULT_METHOD.name: DEFAULT_METHOD}
TASKS = dict.fromkeys(TASKS, _nothing_more) | {"read": _read}
"""
# Says on stderr how many kernels a command has compiled.
COUNTED = """
import sys
from numba.core import event
from terrainwave.cli import main
with event.install_recorder("numba:compile") as recorder:
    try:
        main(prog_name="terrainwave")
    finally:
        n = sum(e.is_start for _, e in recorder.buffer)
        print(f"compiled: {n}", file=sys.stderr)
"""
NOWHERE = """
from terrainwave.cli import main
from terrainwave.coding import kernel_places
kernel_places._folders_of_the_user = lambda: iter(())
main(prog_name="terrainwave")
"""


@pytest.fixture
def folder():
    """A stranger's folder with a raster, `home`, and one that nobody can write, `kernels`."""
    with visible_folder() as root:
        home = own_folder(root / "home")
        write_geotiff(home / "dem.tif", np.arange(12000.0).reshape(100, 120).astype("float32"))
        (home / "dem.tif").chmod(0o644)
        (root / "kernels").mkdir()
        forbid_writing(root / "kernels")
        yield root


def settings(folder, **more):
    home = folder / "home"
    found = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT / "src"), "TMPDIR": str(home)}
    found |= {"XDG_CACHE_HOME": str(home / "cache"), "HOME": "/nonexistent"}
    found |= {"NUMBA_CACHE_DIR": str(folder / "kernels"), "PYTHONDONTWRITEBYTECODE": "1"}
    found["TERRAINWAVE_NATIVE"] = "0"  # the library compiles nothing
    return found | more


def run(folder, *words, program=COUNTED, by=as_stranger, **more):
    """Run a command; return its status, its lines on stderr and how many kernels it compiled."""
    done = subprocess.run(
        by([sys.executable, "-c", program, *map(str, words)]),
        env=settings(folder, **more), cwd=folder / "home", capture_output=True, text=True,
    )  # fmt: skip
    lines = done.stderr.splitlines()
    n_compiled = [int(line.split()[1]) for line in lines if line.startswith("compiled: ")]
    lines = [line for line in lines if not line.startswith(("compiled: ", "note: the raster"))]
    return done.returncode, lines, *n_compiled


def test_where_kernels_are_kept_is_said_once_and_the_second_run_compiles_nothing(folder):
    status, (line,), n_compiled = run(folder, *COMPRESS)
    assert status == 0
    assert n_compiled > 0
    assert line == (
        "compiling kernels for this machine, once: this takes some seconds; they are kept in"
        f" {folder}/home/cache/terrainwave/kernels, as {folder}/kernels cannot be written"
    )
    assert run(folder, *COMPRESS) == (0, [], 0)


@pytest.mark.full
def test_warmup_that_can_keep_nothing_ends_at_once_with_status_1(folder):
    for found in (
        run(folder, "warmup", program=NOWHERE),
        run(folder, "warmup", TERRAINWAVE_NUMBA_CACHE="0")[:2],
        run(folder, "warmup", NUMBA_DISABLE_JIT="1")[:2],
        run(folder, "warmup", "--to", folder / "kernels")[:2],
        run(folder, "warmup", "--to", folder / "other" / "kernels")[:2],
    ):
        status, (line,) = found
        assert status == 1
        assert line.startswith("terrainwave: ")
        assert "no kernel was kept" in line


def blocks(language):
    """Return the page's blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def image():
    """Folders of an image, empty: of kernels, of the package, of programs."""
    with visible_folder() as root:
        (root / "counted.py").write_text(COUNTED)
        program = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {root}/counted.py "$@"\n'
        (root / "terrainwave").write_text(program)
        (root / "terrainwave").chmod(0o755)
        yield root


def in_shell(image, folder, text, *, by, **more):
    """Run lines of the page in a shell; return how many kernels each command compiled."""
    environment = settings(folder, PATH=f"{image}:{os.environ['PATH']}", **more)
    environment["PYTHONPATH"] = str(image / "package")
    if by is list:
        environment |= {"HOME": os.environ["HOME"], "TMPDIR": tempfile.gettempdir()}
    if "NUMBA_CACHE_DIR" not in more:
        del environment["NUMBA_CACHE_DIR"]
    text = text.replace("/opt/kernels", str(image / "kernels"))
    done = subprocess.run(
        by(["sh", "-ec", text]),
        env=environment, cwd=folder / "home", capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, (text, done.stderr)
    if "--to" in text:
        assert done.stdout.endswith(f"NUMBA_CACHE_DIR={image}/kernels\n")
    return [int(number) for number in re.findall("^compiled: ([0-9]+)$", done.stderr, re.MULTILINE)]


@pytest.mark.full
@pytest.mark.gl  # warmup draws pictures
def test_every_line_of_the_page_runs_and_others_compile_nothing(image, folder):
    variables, by = {}, list
    (dockerfile,) = blocks("dockerfile")
    for line in dockerfile.splitlines():
        word, _, rest = line.partition(" ")
        if line == "RUN pip install terrainwave":  # `make release-check` runs it
            ignored = shutil.ignore_patterns("__pycache__")
            package = image / "package" / "terrainwave"
            shutil.copytree(ROOT / "src" / "terrainwave", package, ignore=ignored)
            with (package / "cli" / "warmup.py").open("a", encoding="utf-8") as file:
                file.write(FEWER_KERNELS)
        elif word == "ENV":
            name, _, value = rest.partition("=")
            variables[name] = value.replace("/opt/kernels", str(image / "kernels"))
        elif word == "RUN":
            (n_compiled,) = in_shell(image, folder, rest, by=by, **variables)
            assert n_compiled > 10
        elif word == "USER":
            assert rest == "nobody"
            by = as_stranger
            forbid_writing(image)
        elif word == "ENTRYPOINT":
            (program,) = json.loads(rest)
            line = f"{program} compress dem.tif made.twz --max-error 0.25"
            assert in_shell(image, folder, line, by=by, **variables) == [0]
        else:
            assert word == "FROM"
    for path in (image / "kernels", *(image / "kernels").rglob("*")):
        path.chmod(path.stat().st_mode | 0o200)
    for text in blocks("bash"):
        who, _, lines = text.partition("\n")
        assert who in ("# as root", "# as nobody")
        if who == "# as root":
            in_shell(image, folder, lines, by=list)
            forbid_writing(image / "kernels")
        else:
            (folder / "home" / "dem.twz").unlink(missing_ok=True)
            compiled = in_shell(image, folder, lines, by=as_stranger)
            assert compiled
            assert not any(compiled)
        for path in (image / "kernels", *(image / "kernels").rglob("*")):
            path.chmod(path.stat().st_mode | 0o200)
