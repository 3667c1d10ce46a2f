"""Lines that install a release, as documents and messages have them, from an index that has one.

The release is this checkout's with the version that it leads to. It lies in an index beside a build
between releases, which nobody must get who did not ask for one.
"""

import functools
import http.server
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import pytest
from packaging.version import Version
from servers import running

from terrainwave import __version__
from terrainwave.errors import TerrainwaveError
from terrainwave.extras import need
from tools.set_version import set_version

pytestmark = pytest.mark.full

ROOT = Path(__file__).parent.parent
RELEASE = Version(__version__).base_version
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
USERS_EXTRAS = sorted(set(EXTRAS) - {"bench", "fuzz", "release", "docs", "dev"})


def install_lines():
    """Return the lines of documents and of messages that install terrainwave by its name."""
    listed = subprocess.check_output(["git", "-C", ROOT, "ls-files"], text=True).splitlines()
    texts = [
        (ROOT / name).read_text()
        for name in listed
        if name.endswith((".md", ".ipynb", "metadata.txt", ".py"))
        and name.startswith(("README", "docs/", "js/README", "qgis/", "src/terrainwave/"))
    ]
    # A message names the extra that is missing: each that there is.
    for extra in USERS_EXTRAS:
        with pytest.raises(TerrainwaveError) as raised:
            need("no_such_module", extra=extra)
        texts.append(str(raised.value))
    pattern = r"""pip install (?:--?[\w-]+ )*\\?["']?terrainwave(?:\[[\w,-]+\])?(?![\w\[-])"""
    found = {line for text in texts for line in re.findall(pattern, text)}
    return sorted({line.replace("\\", "").replace('"', "").replace("'", "") for line in found})


def wheel_of(version, folder):
    """Return the wheel of a copy of this checkout that has another version."""
    copy = folder / f"source-{version}"
    for name in subprocess.check_output(["git", "-C", ROOT, "ls-files"], text=True).splitlines():
        if (ROOT / name).is_file() and not name.startswith(("tests/", "benchmarks/")):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy / name)
    set_version(str(version), copy)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder]
    # The library is of no concern here.
    subprocess.run([*pip, copy], check=True, env=os.environ | {"TERRAINWAVE_BUILD": "none"})
    (wheel,) = folder.glob(f"terrainwave-{version}-*.whl")
    return wheel


@pytest.fixture(scope="module")
def index(tmp_path_factory):
    """Serve an index with a release and a build after it; yield its address."""
    folder = tmp_path_factory.mktemp("index")
    project = folder / "simple" / "terrainwave"
    project.mkdir(parents=True)
    major, minor, _ = RELEASE.split(".")
    for version in (RELEASE, f"{major}.{int(minor) + 1}.0.dev0"):
        wheel = wheel_of(version, folder)
        shutil.copy(wheel, project)
    links = "".join(f'<a href="{path.name}">{path.name}</a>' for path in project.glob("*.whl"))
    (project / "index.html").write_text(f"<!DOCTYPE html><html><body>{links}</body></html>")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=folder)
    with running(http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)) as server:
        yield f"http://127.0.0.1:{server.server_port}/simple"


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Return a fresh environment's folder of programs."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, with_pip=True)
    return folder / "bin"


def run(environment, index, *arguments):
    """Run a program of a fresh environment that knows the index."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "NUMBA_CACHE_DIR")
    variables = {key: value for key, value in os.environ.items() if key not in hidden}
    program, *rest = arguments
    return subprocess.run(
        [environment / program, *rest],
        env=variables | {"PIP_EXTRA_INDEX_URL": index, "PIP_DISABLE_PIP_VERSION_CHECK": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_documents_say_how_to_install():
    lines = install_lines()
    assert "pip install terrainwave" in lines
    assert "pip install --upgrade terrainwave" in lines
    assert set(USERS_EXTRAS) == {name for line in lines for name in re.findall(r"\[(\w+)\]", line)}


def lines_with_all_extras():
    """Return a line for each way to ask pip, with the extras of all lines that ask so."""
    ways = {}
    for line in install_lines():
        way, _, extras = line.rstrip("]").partition("[")
        ways.setdefault(way, set()).update(filter(None, extras.split(",")))
    return [
        way + (f"[{','.join(sorted(extras))}]" if extras else "") for way, extras in ways.items()
    ]


@pytest.mark.parametrize("line", lines_with_all_extras())
def test_a_line_finds_the_release_and_its_extra(line, index, environment, tmp_path):
    report = tmp_path / "report.json"
    # What it depends on is resolved below and in `make release-check`.
    asks = ["--dry-run", "--no-deps", "--ignore-installed", "--report", report]
    done = run(environment, index, *line.split(), *asks)
    assert done.returncode == 0, done.stderr
    # An extra that does not exist is a warning alone.
    assert "does not provide the extra" not in done.stderr
    packages = json.loads(report.read_text())["install"]
    (ours,) = (found for found in packages if found["metadata"]["name"] == "terrainwave")
    assert ours["metadata"]["version"] == RELEASE
    assert ours["requested"]


def test_what_a_line_installs_is_that_release(index, environment):
    done = run(environment, index, *"pip install --quiet terrainwave".split())
    assert done.returncode == 0, done.stderr
    said = run(environment, index, "terrainwave", "--version").stdout
    assert said == f"terrainwave, version {RELEASE}\n"
    code = "import terrainwave; print(terrainwave.__version__)"
    assert run(environment, index, "python", "-c", code).stdout == f"{RELEASE}\n"
