"""Are the import rules of ARCHITECTURE.md kept?"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "src" / "terrainwave"

ROOT = {"errors", "progress", "arguments", "_version", "extras", "cache"}
# What each room may import besides itself and ROOT, in the order of the data's path. Nothing else.
CODING = ROOT | {"coding"}
GRID = CODING | {"grid"}
MAY_IMPORT = {
    "errors": set(),
    "_version": set(),
    "progress": {"errors"},
    "extras": {"errors"},
    "cache": set(),
    "arguments": {"errors", "container"},
    "coding": ROOT,
    "grid": CODING | {"codec"},
    "codec": GRID,
    "tri": CODING,
    "container": ROOT | {"grid"},
    "raster_io": ROOT | {"grid", "container"},
    "read": GRID | {"codec", "container"},
    "export": GRID | {"tri", "container", "raster_io", "read", "terrain"},
    "mesh": GRID | {"codec", "tri", "container", "raster_io", "read", "export", "terrain"},
    "write": GRID | {"codec", "tri", "container", "raster_io", "read", "mesh", "terrain"},
    "globe": GRID | {"tri", "container", "raster_io", "read", "export", "mesh", "terrain"},
    "render": GRID | {"tri", "container", "raster_io", "read", "export", "mesh", "terrain"},
    "ext": ROOT | {"raster_io", "export", "mesh", "write", "globe", "render", "terrain"},
    "terrain": GRID
    | {"codec", "tri", "container", "raster_io", "read", "export", "mesh", "render", "ext"},
    "verification": GRID | {"raster_io", "terrain"},
}
# Entrances: what users start may import all that is above.
ENTRANCES = {"__init__", "cli", "__main__"}
MAY_OPEN_FILES = {"raster_io", "container", "cli", "verification", "coding"}


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def group_of(path):
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


def imported_groups(path):
    """Yield the groups a module imports, within functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "terrainwave":
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "terrainwave":
                    yield (*alias.name.split("."), "__init__")[1]


def test_every_module_has_a_line():
    assert {group_of(path) for path in modules()} - ENTRANCES <= set(MAY_IMPORT)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_imports_only_what_its_room_may(path):
    group = group_of(path)
    if group in ENTRANCES:
        return
    others = set(imported_groups(path)) - {group}
    assert others <= MAY_IMPORT[group]


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
