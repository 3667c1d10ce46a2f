"""Are the import rules of ARCHITECTURE.md kept?"""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from terrainwave.names import METHODS

REPOSITORY = Path(__file__).parent.parent
PACKAGE = REPOSITORY / "src" / "terrainwave"
PLAN = (REPOSITORY / "ARCHITECTURE.md").read_text(encoding="utf-8")

ROOT = {"errors", "progress", "names", "arguments", "_version", "extras", "forks", "cache"}
# What each room may import besides itself, in the order of the data's path: rooms above it, and
# none beside it. Nothing else, within functions neither.
GRID = ROOT | {"coding", "grid"}
MAY_IMPORT = {
    "errors": set(),
    "_version": set(),
    "progress": {"errors", "arguments"},
    "extras": {"errors"},
    "names": set(),
    "forks": set(),
    "cache": {"forks"},
    "arguments": {"errors", "names"},
    "coding": ROOT,
    "grid": ROOT | {"coding"},
    "codec": GRID,
    "tri": ROOT | {"coding"},
    "container": GRID,
    "place": ROOT,
    "raster_io": ROOT | {"grid", "container", "place"},
    "read": GRID | {"codec", "container"},
    "file": GRID | {"codec", "container", "raster_io", "place", "read"},
    "mesh": GRID | {"codec", "tri", "container", "raster_io", "read", "file"},
    "export": GRID | {"tri", "container", "raster_io", "place", "read", "file"},
    "write": GRID | {"codec", "tri", "container", "raster_io", "place", "read", "file", "mesh"},
    "globe": GRID | {"tri", "container", "raster_io", "place", "read", "file", "mesh", "export"},
    "render": GRID | {"tri", "container", "raster_io", "place", "read", "file", "mesh", "export"},
    "ext": ROOT
    | {"grid", "container", "raster_io", "place", "file", "mesh", "export", "write", "globe"}
    | {"render"},
    "terrain": ROOT | {"grid", "tri", "raster_io", "file", "mesh", "export", "render", "ext"},
    # Knows nothing of what made a file: neither mesh nor write.
    "verification": GRID | {"raster_io", "place", "terrain"},
}
# Entrances: what users start may import all that is above.
ENTRANCES = {"__init__", "cli", "__main__"}
MAY_OPEN_FILES = {"raster_io", "container", "cli", "verification", "coding"}


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def group_of(path):
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


def imported_groups(path):
    """Yield the groups a module imports, within functions too."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "terrainwave":
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "terrainwave":
                    yield (*alias.name.split("."), "__init__")[1]


def test_every_module_has_a_line():
    assert {group_of(path) for path in modules()} - ENTRANCES <= set(MAY_IMPORT)


def rooms_of_the_plan():
    """Yield the names in backticks of each row of ARCHITECTURE.md's table: rooms, what is in."""
    table = PLAN.split("## Rooms")[1].split("\n## ")[0]
    for row in re.findall(r"^\| (`.*?) \| (.*) \|$", table, re.MULTILINE):
        yield tuple(re.findall(r"`([\w/]+)`", cell) for cell in row)


def exists(path):
    return path.is_dir() or path.with_suffix(".py").is_file()


def test_the_plan_has_a_row_for_every_room():
    rooms = [room.rstrip("/") for names, _ in rooms_of_the_plan() for room in names]
    assert sorted(rooms) == sorted(set(MAY_IMPORT) - {"_version"} | {"cli"})
    assert all(exists(PACKAGE / room) for room in rooms)


def test_what_the_plan_says_is_in_a_room_is_there():
    for (room, *_), names in rooms_of_the_plan():
        for name in names:
            if name.islower() and name not in METHODS:
                assert exists(PACKAGE / room / name) or exists(PACKAGE / name), f"{room} {name}"


def test_paths_in_the_plan_exist():
    for path in re.findall(r"`([\w./-]+(?:/|\.(?:py|md)))`", PLAN):
        assert any((folder / path).exists() for folder in (PACKAGE, REPOSITORY)), path


def test_the_plan_is_two_pages():
    assert PLAN.count("\n") <= 110


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_module_imports_only_what_its_room_may(path):
    group = group_of(path)
    if group in ENTRANCES:
        return
    others = set(imported_groups(path)) - {group}
    assert others <= MAY_IMPORT[group]


def test_no_line_leads_back_to_itself():
    seen = ROOT
    for room, others in list(MAY_IMPORT.items())[len(ROOT) :]:
        assert others <= seen, room
        seen = seen | {room}


def test_private_attributes_stay_in_their_module():
    """`terrain._decoder` is somebody else's; `self._x`, `cls._x` and named tuples' are not."""
    allowed = {"_replace", "_asdict", "_fields", "_make"}
    for path in modules():
        if path.name in ("compiler.py", "jit.py", "kernel_cache.py"):  # numba's own: they say why
            continue
        tree = tree_of(path)
        own = {node.attr for node in ast.walk(tree) if _is_own(node)} | {
            node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not _is_own(node):
                is_free = node.attr.startswith("__") or node.attr in allowed | own
                assert is_free, f"{path.name}:{node.lineno} uses {node.attr}"


def _is_own(node):
    return isinstance(node, ast.Attribute) and getattr(node.value, "id", "") in ("self", "cls")


def test_only_the_table_of_methods_knows_them_by_name():
    """What a method can do is a property of `names.Method`; nobody asks for its name."""
    for path in modules():
        if group_of(path) == "names":
            continue
        tree = tree_of(path)
        own = {id(node.value) for node in ast.walk(tree) if _is_name_of_refiner(node)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and node.value in METHODS and id(node) not in own:
                raise AssertionError(f"{path.name}:{node.lineno} has the name {node.value!r}")


def _is_name_of_refiner(node):
    return isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "name"


def test_only_place_asks_a_crs_what_it_is():
    """Nobody else imports pyproj or asks rasterio's CRS whether it is geographic."""
    asked = {"is_geographic", "is_projected", "is_geocentric", "linear_units", "units_factor"}
    for path in modules():
        if group_of(path) == "place":
            continue
        for node in ast.walk(tree_of(path)):
            is_asked = isinstance(node, ast.Attribute) and node.attr in asked
            is_imported = "pyproj" in _imported_libraries(node)
            if is_asked or is_imported:
                raise AssertionError(f"{path.name}:{node.lineno} is for place/ to ask")


def _imported_libraries(node):
    """Return the packages of others that a node imports, by `need` too."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        names = [node.module or ""]
    elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("need", "import_module"):
        names = [arg.value for arg in node.args if isinstance(arg, ast.Constant)]
    else:
        names = []
    return {str(name).split(".")[0] for name in names}


def test_files_are_opened_only_at_the_edge():
    for path in modules():
        if group_of(path) in MAY_OPEN_FILES:
            continue
        for node in ast.walk(tree_of(path)):
            is_open = isinstance(node, ast.Call) and getattr(node.func, "id", "") == "open"
            assert not is_open, f"{path.name}:{node.lineno} opens a file"


@pytest.mark.parametrize(
    "library",
    ["moderngl", "fsspec", "urllib3", "xarray", "zarr", "pyvista", "numba", "rasterio", "pyproj"],
)
def test_importing_terrainwave_needs_no_heavy_library(library):
    code = f"import sys, terrainwave; sys.exit({library!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
