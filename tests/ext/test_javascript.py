"""Does the reader in JavaScript (js/) give what Python gives?"""

import gzip
import json
import re
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest
from ext.rasters import BOUNDS, hills, write_twz
from golden_files import GOLDEN, digests

import terrainwave
from benchmarks.slow_server import SlowServer
from terrainwave.grid.quadtree import Block

JS = Path(__file__).parents[2] / "js"

pytestmark = pytest.mark.full


def node(*arguments, cwd=JS, told=None):
    """Return what a script prints that is told a text."""
    done = subprocess.run(
        ["node", *map(str, arguments)], cwd=cwd, capture_output=True, text=True, timeout=600,
        check=False, input=told,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def ask(*questions):
    """Return the answers to questions about files."""
    lines = node("testing/serve.js", told="\n".join(map(json.dumps, questions)))
    return [json.loads(line) for line in lines.splitlines()]


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hills")
    return write_twz(folder, hills(300, 341) * 4, BOUNDS, max_error=8)


@pytest.fixture
def server(twz):
    """Yield a server of the file, which counts what it is asked for."""
    with SlowServer(twz.parent, 0.0, 0) as found:
        yield found


def test_its_own_tests_pass():
    node("--test")


def test_it_passes_the_conformance_set():
    runner = JS.parent / "tools" / "run_conformance.py"
    command = [sys.executable, runner, "--", "node", JS / "testing" / "conformance.js"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    passed = dict(re.findall(r"^(heights|invalid) +(\d+)", done.stdout, re.M))
    assert int(passed["heights"]) >= 58
    assert int(passed["invalid"]) >= 168


def test_heights_and_masks_of_golden_files_are_those_of_python(twz):
    manifest = json.loads((GOLDEN / "v2" / "manifest.json").read_text())
    paths = [GOLDEN / "v2" / name for name in manifest["files"]]
    assert len(paths) >= 58
    paths.append(twz)
    found = ask(*({"what": "digests", "path": str(path)} for path in paths))
    assert found == [digests(path) for path in paths]


def test_it_opens_a_url_by_two_requests_at_most(server, twz):
    (found,) = ask({"what": "open", "url": server.url(twz.name)})
    assert 1 <= server.n_requests <= 2
    with terrainwave.open(twz) as terrain:
        assert found["nRows"] == terrain.shape[0]
        assert found["crs"] == terrain.crs
        left, bottom, right, top = terrain.bounds
    bounds = found["bounds"]
    assert bounds == {"left": left, "bottom": bottom, "right": right, "top": top}


def test_the_module_has_at_most_160_kb_compressed():
    """With all five methods: 67 kB are code, 50 tables of the annexes, 24 JavaScript."""
    modules = [path for path in (JS / "src").iterdir() if path.suffix == ".js"]
    assert sum(len(gzip.compress(path.read_bytes())) for path in modules) <= 160_000


def test_places_and_errors_are_those_of_python(server, twz):
    x, y = 8.2503, 46.2041
    place = {"x": x, "y": y, "row": 1, "col": 2}
    (found,) = ask({"what": "values", "url": server.url(twz.name), **place})
    with terrainwave.open(twz) as terrain:
        assert found["sample"] == pytest.approx(terrain.sample([(x, y)])[0], rel=1e-9)
        assert found["coarse"] == pytest.approx(terrain.sample([(x, y)], level=1)[0], rel=1e-9)
        last = terrain.n_levels - 1
        assert found["blockError"] == terrain.block_error(Block(last, 1, 2))
        assert found["rootError"] == terrain.block_error(Block(0, 0, 0)) > 0
        assert found["transform"] == pytest.approx(list(terrain.transform_of(0)[:6]), rel=1e-12)
        assert found["maxError"] == terrain.max_error
    assert server.n_bytes < twz.stat().st_size


def test_the_package_runs_the_example_of_its_readme(twz, tmp_path):
    name = subprocess.run(
        ["npm", "pack", "--silent", "--offline", "--pack-destination", tmp_path], cwd=JS,
        capture_output=True, text=True, check=True,
    ).stdout.strip()  # fmt: skip
    with tarfile.open(tmp_path / name) as archive:
        archive.extractall(tmp_path, filter="data")
    (tmp_path / "node_modules").mkdir()
    (tmp_path / "package").rename(tmp_path / "node_modules" / "terrainwave")
    assert (tmp_path / "node_modules" / "terrainwave" / "index.d.ts").exists()
    examples = re.findall(r"^```js\n(.*?)^```", (JS / "README.md").read_text(), re.M | re.S)
    (example,) = (text for text in examples if "node:fs" in text)
    (tmp_path / "example.mjs").write_text(example)
    (tmp_path / "dem.twz").write_bytes(twz.read_bytes())
    printed = node("example.mjs", cwd=tmp_path)
    with terrainwave.open(twz) as terrain:
        expected = terrain.read((10, 20, 2, 3)).ravel().tolist()
    assert list(map(int, re.findall(r"-?\d+", printed.partition("[")[2]))) == expected
