"""An option is declared once: its field is the keyword, the command's option and the metadata."""

import ast
import inspect
import re
from dataclasses import dataclass
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from commands import run
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.cli import output
from terrainwave.cli.options import declared
from terrainwave.container.metadata import ORIGIN
from terrainwave.errors import InvalidArgumentError
from terrainwave.export.mesh import Mesh
from terrainwave.export.shapes import MESH_ENDINGS, Shape
from terrainwave.option_sets import FLAG, OptionSet, number, numbers, option, whole, words
from terrainwave.render.window.view_options import ViewOptions
from terrainwave.write.compress_options import Options

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True, kw_only=True)
class Store(terrainwave.Store):
    passes: int = option(whole(1, 2, 3), "Passes of a test.", default=1)


@dataclass(frozen=True, kw_only=True)
class Made(OptionSet):
    width: float | None = option(number(above=0), "Width of a test.")
    kind: str = option(words("round", "square"), "Kind of a test.", default="round")
    place: tuple[float, float] | None = option(numbers("x, y"), "Place of a test.")
    is_flat: bool = option(FLAG, "Flat.", default=False)
    proof: bool = option(FLAG, "Prove nothing.", default=True)
    hidden: int = option(whole(1, 2), default=1)


@pytest.fixture
def _method_with_an_option_of_its_own(monkeypatch):
    monkeypatch.setattr("terrainwave.codec.store.Store", Store)
    output.own_sets.cache_clear()
    yield
    output.own_sets.cache_clear()


@pytest.mark.usefixtures("_method_with_an_option_of_its_own")
def test_a_field_of_a_method_is_keyword_option_help_and_metadata(tmp_path):
    write_geotiff(tmp_path / "dem.tif", terrain_like(33, 33))
    with pytest.raises(InvalidArgumentError, match="found passes 4, expected one of 1, 2, 3"):
        Store(passes=4)
    help = " ".join(run("compress", "--method", "store", "--help").stdout.split())
    assert help.endswith("-o passes=1|2|3 Passes of a test.")
    wrong = run("compress", tmp_path / "dem.tif", "a.twz", "-o", "passes=2")
    assert "found -o passes=2 and no --method, expected --method store" in wrong.stderr
    options = ["--method", "store", "-o", "passes=2", "--max-error", 1]
    done = run("compress", tmp_path / "dem.tif", "--to", tmp_path / "out", *options)
    assert done.exit_code == 0, done.output
    with terrainwave.open(tmp_path / "out" / "dem.twz") as terrain:
        assert terrain.header.metadata[ORIGIN]["options"]["passes"] == 2


def test_fields_of_a_class_are_options_of_a_command():
    taken = {}
    made = declared(Made)(click.command("test")(lambda **given: taken.update(given)))
    help = CliRunner().invoke(made, ["--help"]).output
    for text in ("--width NUMBER", "--kind [round|square]", "--place X,Y", "--no-proof", "round]"):
        assert text in help
    assert "hidden" not in help
    CliRunner().invoke(made, ["--width", "2", "--place", "3,4.5", "--no-proof"])
    assert Made(**taken) == Made(width=2, place=(3, 4.5), proof=False)
    for typed, text in (("--width nan", "found nan, expected a finite number > 0"),
                        ("--place 3", "found 3, expected two finite numbers: x, y")):  # fmt: skip
        assert text in CliRunner().invoke(made, typed.split()).output


def test_fields_of_a_class_are_metadata_if_they_are_set():
    assert Made().to_metadata() == {"kind": "round", "proof": True, "hidden": 1}
    assert Made(width=0.5, proof=False).to_metadata()["width"] == 0.5


def keywords_of(function):
    return {name: given.default for name, given in inspect.signature(function).parameters.items()}


@pytest.mark.parametrize(
    ("function", "options"),
    [
        (terrainwave.compress, Options),
        (terrainwave.Terrain.view, ViewOptions),
        (Mesh.save, Shape),
        (terrainwave.save_lods, Shape),
    ],
)
def test_keywords_of_functions_are_the_declared_fields(function, options):
    defaults = {one.name: one.default for one in options.options()}
    assert defaults.items() <= keywords_of(function).items()


def test_the_plugin_of_qgis_offers_the_methods_and_formats_that_are_declared():
    """It imports nothing of the package, so it has their names once more."""
    plugin = ast.parse((ROOT / "qgis/terrainwave_plugin/algorithms.py").read_text("utf-8"))
    named = {
        ast.unparse(node.targets[0]): node.value
        for node in plugin.body
        if isinstance(node, ast.Assign)
    }
    (method,) = (one for one in Options.options() if one.name == "method")
    assert tuple(ast.literal_eval(named["METHODS"])) == method.metadata["kind"].choices
    assert ast.literal_eval(named["MESH_ENDINGS"]) == MESH_ENDINGS


def test_the_page_on_meshes_has_a_row_of_each_format():
    page = (ROOT / "docs/meshes.md").read_text("utf-8")
    first = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `.")]
    assert sorted(re.findall(r"`(\.\w+)`", " ".join(first))) == sorted(MESH_ENDINGS)
