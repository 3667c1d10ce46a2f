"""Is the package for JavaScript usable as web developers use one: bundlers, hosts, policies?"""

import json
import os
import re
import shutil
import subprocess
import tarfile
from pathlib import Path

import pytest
from ext.browser import wait_until
from ext.rasters import BOUNDS, hills, write_twz
from ext.static_server import KNOWN, static_server

import terrainwave
from terrainwave.ext.publish import publish_site

HERE = Path(__file__).parent
JS = HERE.parents[1] / "js"
BINARIES = HERE / "node_modules" / ".bin"

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
def package(tmp_path_factory):
    """Return the folder of the package as npm unpacks it."""
    folder = tmp_path_factory.mktemp("package")
    command = ["npm", "pack", "--silent", "--offline", "--pack-destination", str(folder)]
    packed = run(command, JS).strip()
    with tarfile.open(folder / packed) as archive:
        archive.extractall(folder, filter="data")
    return folder / "package"


@pytest.fixture
def project(tmp_path, package):
    """Return the folder of a project that has the package installed, as npm would."""
    shutil.copytree(package, tmp_path / "node_modules" / "terrainwave")
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
    return done.stdout + done.stderr


WORKER = "read-worker=terrainwave/src/read-worker.js"
WEBPACK = """
const [path, target] = process.argv.slice(2);
const done = (error, stats) => {
  const { errors, warnings } = stats.toJson();
  const own = warnings.filter(({ moduleName }) => !moduleName.includes("maplibre-gl"));
  for (const { message } of [...errors, ...own]) console.log(`warning: ${message}`);
};
const performance = { hints: false }; // of sizes
require(path)({ mode: "production", target, performance, entry: "./main.js" }, done);
"""


def bundle(bundler, project, *entries, platform="browser", form="esm"):
    """Make `dist/main.js` of the project's main.js, and check that the bundler has no warning."""
    if bundler == "vite":
        run([BINARIES / "vite", "build"], project)
        return
    if bundler == "webpack":
        (project / "webpack.cjs").write_text(WEBPACK)
        target = {"browser": "web"}.get(platform, platform)
        command = ["node", "webpack.cjs", HERE / "node_modules" / "webpack", target]
    elif bundler == "esbuild":
        options = ["--bundle", f"--platform={platform}", f"--format={form}", "--outdir=dist"]
        command = [BINARIES / "esbuild", "main.js", *entries, *options]
    else:
        resolve = HERE / "node_modules" / "@rollup" / "plugin-node-resolve"
        inputs = [word for entry in ("main.js", *entries) for word in ("-i", entry)]
        command = [BINARIES / "rollup", *inputs, "-d", "dist", "-p", resolve]
    assert "warning" not in run(command, project).lower()
    for page in project.glob("*.html"):
        shutil.copy(page, project / "dist")


def found_by(browser, folder, twz, page="index.html", **server_options):
    """Return what the page of a folder reads, and the paths that it asked for."""
    shutil.copy(twz, folder / "dem.twz")
    with static_server(folder, **server_options) as server:
        browser.get(f"{server.address}/{page}")
        found = browser.execute_async_script(READ, f"{server.address}/dem.twz")
        return found, [path for path, _ in server.asked]


def loads_of_worker(asked):
    return sum("read-worker" in path for path in asked)


@pytest.mark.parametrize("bundler", ["vite", "webpack", "esbuild", "rollup"])
def test_a_bundle_for_pages_reads_by_workers(project, browser, twz, heights, bundler):
    bundle(bundler, project, WORKER)
    found, asked = found_by(browser, project / "dist", twz)
    assert found == {"heights": heights, "warned": []}
    if bundler != "webpack":  # which numbers its files
        assert loads_of_worker(asked) >= 1


@pytest.mark.parametrize(
    ("bundler", "form", "kind"),
    [
        ("webpack", "", "commonjs"), ("esbuild", "cjs", "commonjs"), ("esbuild", "esm", "module"),
        ("rollup", "", "module"),
    ],
)  # fmt: skip
def test_a_bundle_for_node_reads_by_workers(project, twz, heights, bundler, form, kind):
    bundle(bundler, project, WORKER, platform="node", form=form)
    shutil.rmtree(project / "node_modules")  # nothing is read from there
    (project / "dist" / "package.json").write_text(json.dumps({"type": kind}))
    (project / "run.mjs").write_text("""
        await import("./dist/main.js");
        console.log(JSON.stringify(await globalThis.read(process.argv[2])));
    """)
    with static_server(twz.parent) as server:
        found = json.loads(run(["node", "run.mjs", f"{server.address}/{twz.name}"], project))
    assert found == {"heights": heights, "warned": []}


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
    assert "no workers, so the caller's thread decodes" in found["warned"][0]


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


README = (JS / "README.md").read_text()
MAP_PAGE = """<!doctype html><title>A map</title><link rel="icon" href="data:,">
<style>html, body, #map { height: 100%; margin: 0 }</style>
<div id="map"></div><script type="module" src="./main.js"></script>"""
IN_A_SCRIPT = """
import * as maplibregl from "maplibre-gl";
import { TileMaker, addTerrains, demSource, publishedTerrains } from "terrainwave/maplibre";

publishedTerrains("site/terrains.json").then((terrains) => {
  LINE;
  const [{ described: { bounds } }] = terrains;
  const sources = { dem: demSource(terrains[0]) };
  const style = { version: 8, sources, terrain: { source: "dem" }, layers: [] };
  globalThis.map = new maplibregl.Map({ container: "map", bounds, style });
});
"""


def map_program(bundler, major):
    """Return the program of the README for a bundler and a release of MapLibre."""
    blocks = re.findall(r"^```js\n(.*?)^```", README, re.M | re.S)
    (text,) = (block for block in blocks if "new maplibregl.Map(" in block)
    if major == 5 or bundler != "vite":
        text = re.sub(r"^.* // MapLibre 6 with Vite\n", "", text, flags=re.M)
    if bundler != "vite":
        text = re.sub(r'^import "maplibre-gl/.*css";\n', "", text, flags=re.M)
        (row,) = re.findall(
            rf"^\| .*{bundler}.* \|.*`(maplibregl.setWorkerUrl.*)` \|$", README, re.M | re.I
        )
        text = text.replace("const terrains", f"{row};\nconst terrains")
    return text.replace("const map =", "globalThis.map =")


@pytest.mark.gl
@pytest.mark.parametrize(
    ("bundler", "major"),
    [("vite", 6), ("vite", 5), ("esbuild", 6), ("rollup", 6), ("esbuild iife", 5)],
)
def test_a_bundled_map_draws_the_terrain(project, browser, twz, bundler, major):
    release = HERE / "node_modules" / ("maplibre-gl" if major == 6 else "maplibre-gl-5")
    (project / "node_modules" / "maplibre-gl").symlink_to(release)
    (project / "index.html").write_text(MAP_PAGE)
    entries = [WORKER, "worker=terrainwave/map/worker.js"]
    if bundler == "esbuild iife":
        (line,) = re.findall(r"`(addTerrains\(maplibregl, terrains, new TileMaker.*?)`", README)
        (project / "main.js").write_text(IN_A_SCRIPT.replace("LINE", line))
        bundle("esbuild", project, *entries, form="iife")
    else:
        (project / "main.js").write_text(map_program(bundler, major))
        if major == 6:
            entries.append("maplibre-worker=maplibre-gl/dist/maplibre-gl-worker.mjs")
        bundle(bundler, project, *entries)
    publish_site([str(twz)], project / "dist" / "site")
    types = KNOWN | ({".mjs": "text/javascript"} if bundler == "webpack" else {})
    with static_server(project / "dist", types=types) as server:
        browser.get(server.address)
        with terrainwave.open(twz) as terrain:
            height = terrain.sample([(8.25, 46.2)])[0]
        asked = f"globalThis.map?.queryTerrainElevation?.([8.25, 46.2]) - {height}"
        wait_until(browser, f"Math.abs({asked}) < 80")
