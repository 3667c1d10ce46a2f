"""What is said where an optional package is missing."""

import ast
import json
import pickle
import re
import sys
import tomllib
from functools import cache
from itertools import chain
from pathlib import Path

import pytest
from commands import python
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

from terrainwave.errors import TerrainwaveError
from terrainwave.extras import need
from terrainwave.write.compress import compress

PACKAGE = Path(__file__).parent.parent / "src" / "terrainwave"


@pytest.mark.parametrize(
    ("package", "name"),
    [("trimesh", "trimesh"), ("quantized_mesh_encoder.encode", "quantized-mesh-encoder"),
     ("PIL.Image", "pillow")],
)  # fmt: skip
def test_a_missing_package_is_one_line_with_what_to_install(monkeypatch, package, name):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setitem(sys.modules, package.split(".")[0], None)
    with pytest.raises(TerrainwaveError) as caught:
        need(package, extra="mesh", purpose="a picture")
    assert str(caught.value) == f'a picture needs {name}: pip install "terrainwave[mesh]"'


def test_a_package_that_another_lacks_is_the_one_named(tmp_path, monkeypatch):
    (tmp_path / "outer_package.py").write_text("import inner_package\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(TerrainwaveError, match="needs inner-package:"):
        need("outer_package", extra="mesh")


def project():
    path = PACKAGE.parents[1] / "pyproject.toml"
    return tomllib.loads(path.read_text(encoding="utf-8"))["project"]


def test_lines_of_documents_install_extras_that_exist():
    """`make release-check` runs them."""
    root = PACKAGE.parents[1]
    pages = [root / "README.md", root / "js" / "README.md", *(root / "docs").rglob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    lines = set(re.findall(r"pip install (?:--?[\w-]+ )*[\"']?terrainwave(?:\[[\w,-]+\])?", text))
    assert "pip install terrainwave" in lines
    named = {name for line in lines for name in re.findall(r"[\w-]+(?=[,\]])", line)}
    assert {"mesh", "view"} <= named <= set(project()["optional-dependencies"])


@cache
def nodes():
    """Return all nodes of the package's sources."""
    texts = [path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")]
    return [node for text in texts for node in ast.walk(ast.parse(text))]


def calls_of_need():
    for node in nodes():
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "need":
            yield node


@pytest.mark.full
def test_every_extra_that_a_message_names_exists():
    named = set()
    for call in calls_of_need():
        values = [keyword.value for keyword in call.keywords if keyword.arg == "extra"]
        named |= {value.value for value in values if isinstance(value, ast.Constant)}
    assert {"demo", "remote", "serve", "view"} <= named <= set(project()["optional-dependencies"])


def imported_packages():
    """Yield the packages of others that the sources import, in functions and by `need` too."""
    for node in nodes():
        if isinstance(node, ast.ImportFrom):
            yield str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
    for call in calls_of_need():
        if isinstance(call.args[0], ast.Constant):
            yield call.args[0].value


def installed_names(requirements):
    """Return the names of requirements as packages are imported."""
    names = (re.match(r"[\w.-]+", requirement)[0].replace("-", "_") for requirement in requirements)
    return {{"pillow": "PIL", "pysocks": "socks"}.get(name, name) for name in names}


@pytest.mark.full
def test_what_is_imported_is_required_and_the_other_way_round():
    imported = {name.split(".")[0] for name in imported_packages()}
    imported -= {*sys.stdlib_module_names, "terrainwave"}
    always = installed_names(project()["dependencies"])
    optional = installed_names(chain(*project()["optional-dependencies"].values()))
    of_fastapi = {"anyio", "starlette"}
    # What runs our hook.
    hosts = {"PyInstaller"}
    assert always <= imported <= always | optional | of_fastapi | hosts


COMMANDS = {
    "view": ("view", ["view", "TWZ"]),
    "render": ("view", ["render", "TWZ", "a.png"]),
    "serve": ("serve", ["serve", "TWZ"]),
    "publish": ("publish", ["publish", "TWZ", "site"]),
    "site": ("publish", ["site", "page"]),
    "archive": ("pmtiles", ["tiles", "TWZ", "a.pmtiles"]),
    "tiles": ("mesh", ["tiles", "TWZ", "tiles"]),
    "mesh of metres": ("mesh", ["mesh", "TWZ", "a.stl"]),
    "mesh of degrees": ("mesh", ["mesh", "TWZ", "a.glb"]),
    "demo": ("demo", ["demo", "demo"]),
    "remote": ("remote", ["info", "s3://bucket/a.twz"]),
    "upload": ("remote", ["compress", "TIF", "s3://bucket/a.twz"]),
    "distributed": ("distributed", ["compress", "TIF", "b.twz", "--scheduler", "tcp://[::1]:9"]),
}
RUN = """
import json, os, sys
from click.testing import CliRunner

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in json.loads(sys.argv[1]):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
from terrainwave.cli import main

for words in json.loads(sys.argv[2]):
    result = CliRunner().invoke(main, words, prog_name="terrainwave")
    print(json.dumps([result.exit_code, result.stderr.splitlines(), sorted(os.listdir("."))]))
"""


def run_without(packages, names, folder):
    """Return (status, lines, files) of some commands in a process that lacks packages."""
    twz, tif = folder / "dem.twz", folder / "dem.tif"
    write_geotiff(
        tif, terrain_like(33, 40), units=("m",), crs="EPSG:4326",
        transform=Affine(0.01, 0, 8, 0, -0.01, 46),
    )  # fmt: skip
    compress(tif, twz, max_error=0, method="store", block=32, verify=False)
    named = {"TWZ": str(twz), "TIF": str(tif)}
    words = [[named.get(word, word) for word in words] for _, words in map(COMMANDS.get, names)]
    (folder / "here").mkdir()
    done = python(
        RUN, json.dumps(sorted(packages)), json.dumps(words), check=True, cwd=folder / "here"
    )
    found = map(json.loads, done.stdout.splitlines())
    return dict(zip(names, found, strict=True))


def optional_packages():
    extras = project()["optional-dependencies"]
    users = ("demo", "view", "mesh", "remote", "distributed", "serve", "pmtiles")
    return set().union(*(set(installed_names(extras[name])) for name in users))


PLACED = ("view", "render", "serve", "publish", "site", "archive", "tiles", "mesh of degrees")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("hidden", "names"),
    [("all", [*COMMANDS]), ("pyproj", PLACED), ("PIL", ("serve", "archive"))],
)
def test_each_command_names_the_extra_that_has_all_it_needs(tmp_path, hidden, names):
    """`view` named the extra of meshes, as that has pyproj, too."""
    packages = optional_packages() if hidden == "all" else {hidden}
    for name, (status, lines, files) in run_without(packages, names, tmp_path).items():
        line = [one for one in lines if not one.startswith(("compiling", "note"))]
        assert status == 1, (name, lines)
        assert len(line) == 1, (name, lines)
        assert line[0].endswith(f'pip install "terrainwave[{COMMANDS[name][0]}]"'), (name, line)
        assert files == [], name


def test_the_error_travels_between_processes(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(TerrainwaveError) as caught:
        need("trimesh", extra="mesh")
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
