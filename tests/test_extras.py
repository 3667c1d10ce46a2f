"""What is said where an optional package is missing."""

import ast
import sys
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


def test_every_extra_that_a_message_names_exists():
    import tomllib

    project = tomllib.loads((PACKAGE.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    extras = project["project"]["optional-dependencies"]
    named = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "need":
                values = [keyword.value for keyword in node.keywords if keyword.arg == "extra"]
                named |= {value.value for value in values if isinstance(value, ast.Constant)}
    assert {"demo", "remote", "serve", "view"} <= named <= set(extras)
