"""What is said where an optional package is missing."""

import ast
import re
import sys
import tomllib
from itertools import chain
from pathlib import Path

import pytest

from terrainwave.errors import TerrainwaveError
from terrainwave.extras import need

PACKAGE = Path(__file__).parent.parent / "src" / "terrainwave"


def test_need_returns_the_module_named():
    assert need("xml.dom", extra="mesh") is sys.modules["xml.dom"]


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


def calls_of_need():
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "need":
                yield node


def test_every_extra_that_a_message_names_exists():
    named = set()
    for call in calls_of_need():
        values = [keyword.value for keyword in call.keywords if keyword.arg == "extra"]
        named |= {value.value for value in values if isinstance(value, ast.Constant)}
    assert {"demo", "remote", "serve", "view"} <= named <= set(project()["optional-dependencies"])


def imported_packages():
    """Yield the packages of others that the sources import, in functions and by `need` too."""
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
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


def test_what_is_imported_is_required_and_the_other_way_round():
    imported = {name.split(".")[0] for name in imported_packages()}
    imported -= {*sys.stdlib_module_names, "terrainwave"}
    always = installed_names(project()["dependencies"])
    optional = installed_names(chain(*project()["optional-dependencies"].values()))
    of_fastapi = {"anyio", "starlette"}
    assert always <= imported <= always | optional | of_fastapi
