"""Are the import rules of ARCHITECTURE.md kept?"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "src" / "terrainwave"

# Each group may import itself and the groups before it; `codec` and `tri` are siblings.
LAYERS = [
    {
        "errors",
        "_version",
        "_jit",
        "_status",
        "quadtree",
        "quantum",
        "convert",
        "codes",
        "coding",
        "progress",
        "schedule",
    },
    {"codec", "tri", "container", "raster_io", "metrics"},
    {
        "spool",
        "measure",
        "pyramid",
        "encoder",
        "decoder",
        "tile_encoder",
        "tile_decoder",
        "early",
        "block_codes",
        "border_states",
        "job",
        "meshing",
        "mesh_sections",
        "resample",
        "level_errors",
        "arguments",
    },
    {
        "terrain",
        "compression",
        "decompression",
        "distribution",
        "local_passes",
        "proof",
        "subtrees",
        "extraction",
        "globe",
        "height_tile",
        "mesh_storage",
        "patching",
        "mesh_checks",
        "mesh_verification",
        "tile_pyramid",
        "verification",
    },
    {"render", "ext"},
    {"demo", "cli", "__main__"},
]
# Methods that hand a Terrain to a layer above, which they import when they are called.
IMPORTED_LATE = {("terrain", "ext"), ("terrain", "render")}
SIBLINGS = [{"codec", "tri"}, {"codec", "container"}, {"codec", "raster_io"}]
MAY_OPEN_FILES = {"raster_io", "container", "cli", "demo", "spool", "verification", "_jit"}


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def group_of(path):
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


def imported_groups(path, *, late=True):
    """Yield the groups a module imports; `late` also within functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree) if late else tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("terrainwave"):
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            yield from (
                alias.name.split(".")[1]
                for alias in node.names
                if alias.name.startswith("terrainwave.")
            )


def layer_of(group):
    return next((index for index, groups in enumerate(LAYERS) if group in groups), None)


def test_every_module_has_a_layer():
    groups = {group_of(path) for path in modules()} - {"__init__", "__pycache__"}
    assert {group for group in groups if layer_of(group) is None} == set()


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_imports_only_its_layer_and_those_below(path):
    group = group_of(path)
    if group == "__init__":
        return
    for other in imported_groups(path):
        is_late = (group, other) in IMPORTED_LATE and other not in imported_groups(path, late=False)
        if other == "__version__" or is_late:
            continue
        assert layer_of(other) is not None, f"{path.name} imports unknown {other}"
        assert layer_of(other) <= layer_of(group), f"{group} must not import {other}"
        assert not any({group, other} == pair for pair in SIBLINGS), f"{group} imports {other}"


def test_files_are_opened_only_at_the_edge():
    for path in modules():
        if group_of(path) in MAY_OPEN_FILES:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_open = isinstance(node, ast.Call) and getattr(node.func, "id", "") == "open"
            assert not is_open, f"{path.name}:{node.lineno} opens a file"


@pytest.mark.parametrize(
    "library", ["moderngl", "fsspec", "xarray", "zarr", "pyvista", "numba", "rasterio"]
)
def test_importing_terrainwave_needs_no_heavy_library(library):
    code = f"import sys, terrainwave; sys.exit({library!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
