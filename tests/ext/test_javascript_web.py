"""Is the package for JavaScript usable as web developers use one: bundlers, hosts, policies?"""

import contextlib
import os
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest
from ext.browser import chromium
from ext.rasters import hills, write_twz
from ext.static_server import static_server

import terrainwave

HERE = Path(__file__).parent
JS = HERE.parents[1] / "js"
BINARIES = HERE / "node_modules" / ".bin"
BOUNDS = (8.0, 46.0, 8.5, 46.4)

pytestmark = pytest.mark.full

# A page that reads all of a file by two workers, and tells what came of it.
MAIN = """
import { open } from "PACKAGE";
const warned = [];
console.warn = (...words) => warned.push(words.join(" "));
globalThis.read = async (url) => {
  const terrain = await open(url, { workers: 2 });
  const { heights } = await terrain.read();
  // What workers load is in their own lists: how many there are is known by who asks for them.
  await terrain.close();
  return { heights: [...heights], warned };
};
"""
PAGE = '<!doctype html><title>A terrain</title><script type="module" src="MAIN"></script>'
READ = """
    const [url, done] = arguments;
    const ready = () => globalThis.read
      ? globalThis.read(url).then(done, (error) => done(String(error)))
      : setTimeout(ready, 50);
    ready();
"""


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hills")
    return write_twz(folder, hills(300, 341) * 4, BOUNDS, max_error=8, block=32)


@pytest.fixture(scope="module")
def heights(twz):
    with terrainwave.open(twz) as terrain:
        return terrain.read().ravel().tolist()


@pytest.fixture(scope="module")
def browser():
    with chromium() as driver:
        driver.set_script_timeout(120)
        yield driver


@pytest.fixture
def project(tmp_path, twz):
    """Return the folder of a project that has the package installed, as npm would."""
    command = ["npm", "pack", "--silent", "--offline", "--pack-destination", str(tmp_path)]
    packed = run(command, JS).strip()
    with tarfile.open(tmp_path / packed) as archive:
        archive.extractall(tmp_path, filter="data")
    (tmp_path / "node_modules").mkdir()
    (tmp_path / "package").rename(tmp_path / "node_modules" / "terrainwave")
    (tmp_path / "main.js").write_text(MAIN.replace("PACKAGE", "terrainwave"))
    (tmp_path / "index.html").write_text(PAGE.replace("MAIN", "./main.js"))
    (tmp_path / "package.json").write_text('{"name": "project", "type": "module"}')
    return tmp_path


def run(command, folder):
    """Return what a command prints."""
    done = subprocess.run(
        [str(word) for word in command], cwd=folder, capture_output=True, text=True, timeout=300,
        check=False, env=os.environ | {"CI": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def found_by(browser, folder, twz, page="index.html", **server_options):
    """Return what the page of a folder reads, and the paths that it asked for."""
    shutil.copy(twz, folder / "dem.twz")
    with static_server(folder, **server_options) as server:
        browser.get(f"{server.address}/{page}")
        found = browser.execute_async_script(READ, f"{server.address}/dem.twz")
        return found, [path for path, _ in server.asked]


def loads_of_worker(asked):
    return sum("read-worker" in path for path in asked)


def test_vite_builds_it_with_its_default_configuration(project, browser, twz, heights):
    run([BINARIES / "vite", "build"], project)
    found, asked = found_by(browser, project / "dist", twz)
    assert found == {"heights": heights, "warned": []}
    assert loads_of_worker(asked) >= 1


def test_esbuild_bundles_it_with_its_worker(project, browser, twz, heights):
    worker = "read-worker=terrainwave/src/read-worker.js"
    options = ["--bundle", "--format=esm", "--outdir=dist"]
    run([BINARIES / "esbuild", "main.js", worker, *options], project)
    shutil.copy(project / "index.html", project / "dist")
    found, asked = found_by(browser, project / "dist", twz)
    assert found == {"heights": heights, "warned": []}
    assert loads_of_worker(asked) >= 1


@pytest.mark.parametrize("form", ["esm", "iife"])
def test_a_bundle_without_its_worker_decodes_in_the_page_and_says_so(
    project, browser, twz, heights, form
):
    options = ["--bundle", f"--format={form}", "--outdir=dist"]
    run([BINARIES / "esbuild", "main.js", *options], project)
    shutil.copy(project / "index.html", project / "dist")
    found, _ = found_by(browser, project / "dist", twz)
    assert found["heights"] == heights
    assert len(found["warned"]) == 1
    assert "no workers, the page itself decodes" in found["warned"][0]


@pytest.fixture
def site(tmp_path):
    """Return the folder of a page that imports the modules as they are."""
    shutil.copytree(JS / "src", tmp_path / "terrainwave" / "src")
    (tmp_path / "main.js").write_text(MAIN.replace("PACKAGE", "./terrainwave/src/index.js"))
    (tmp_path / "index.html").write_text(PAGE.replace("MAIN", "./main.js"))
    return tmp_path


def test_a_static_host_needs_no_bundler(site, browser, twz, heights):
    found, asked = found_by(browser, site, twz)
    assert found == {"heights": heights, "warned": []}
    assert loads_of_worker(asked) >= 1
    # Workers get the module from the page: it is not loaded again.
    assert sum("core-data" in path for path in asked) == 1


def test_a_policy_that_forbids_webassembly_is_named(site, browser, twz, heights):
    policy = {"Content-Security-Policy": "default-src 'self'"}
    found, _ = found_by(browser, site, twz, headers=policy)
    assert found.startswith("TerrainwaveError: the page forbids WebAssembly")
    assert "script-src 'self' 'wasm-unsafe-eval'" in found
    policy = {"Content-Security-Policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'"}
    found, _ = found_by(browser, site, twz, headers=policy)
    assert found == {"heights": heights, "warned": []}


def test_a_policy_that_forbids_workers_leaves_the_page(site, browser, twz, heights):
    scripts = "script-src 'self' 'wasm-unsafe-eval'; worker-src 'none'"
    policy = {"Content-Security-Policy": f"default-src 'self'; {scripts}"}
    found, _ = found_by(browser, site, twz, headers=policy)
    assert found["heights"] == heights
    assert len(found["warned"]) == 1


@pytest.mark.parametrize("is_exposed", [False, True])
def test_a_host_that_hides_content_range_is_told_what_to_send(
    site, browser, twz, heights, is_exposed
):
    sent = {"Access-Control-Allow-Origin": "*", "Access-Control-Allow-Headers": "Range"}
    if is_exposed:
        sent["Access-Control-Expose-Headers"] = "Content-Range"
    with contextlib.ExitStack() as stack:
        page = stack.enter_context(static_server(site))
        other = stack.enter_context(static_server(twz.parent, headers=sent))
        browser.get(f"{page.address}/index.html")
        found = browser.execute_async_script(READ, f"{other.address}/{twz.name}")
    if is_exposed:
        assert found["heights"] == heights
    else:
        assert found.startswith("SourceError")
        assert "Access-Control-Expose-Headers: Content-Range" in found
