"""Are the import rules of ARCHITECTURE.md kept?"""

import ast
from dataclasses import fields
from functools import cache
from pathlib import Path

import pytest
from commands import python

from terrainwave.names import METHODS, Method

REPOSITORY = Path(__file__).parent.parent
PACKAGE = REPOSITORY / "src" / "terrainwave"
ROOT = {"errors", "progress", "names", "arguments", "_version", "extras", "forks", "cache"}
ROOT |= {"interrupts", "option_sets", "annexes", "native_sources"}
# What each room may import besides itself, in the order of the data's path: rooms above it, and
# none beside it. Nothing else, within functions neither.
GRID = ROOT | {"coding", "grid"}
MAY_IMPORT = {
    "errors": set(),
    "_version": set(),
    "interrupts": set(),
    "progress": {"errors", "arguments", "interrupts"},
    "extras": {"errors"},
    "annexes": {"errors"},
    "native_sources": set(),
    "names": set(),
    "forks": set(),
    "cache": {"forks"},
    "arguments": {"errors", "names"},
    "option_sets": {"errors", "arguments"},
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
    "export": GRID | {"tri", "container", "raster_io", "place", "read", "file", "mesh"},
    "write": GRID | {"codec", "tri", "container", "raster_io", "place", "read", "file", "mesh"},
    "globe": GRID | {"tri", "container", "raster_io", "place", "read", "file", "mesh", "export"},
    "render": GRID | {"tri", "container", "raster_io", "place", "read", "file", "mesh", "export"},
    "ext": ROOT
    | {"grid", "container", "raster_io", "place", "file", "mesh", "export", "write", "globe"}
    | {"render"},
    "terrain": ROOT | {"grid", "tri", "raster_io", "file", "mesh", "export", "render", "ext"},
    # Knows nothing of what made a file: neither mesh nor write.
    "verification": GRID | {"raster_io", "place", "terrain"},
    # Meshes, checked by what knows nothing of them before they are written.
    "lods": ROOT | {"container", "export", "terrain", "verification"},
    "reference": set(),  # shares nothing but the annexes, which it reads itself
    "capsule": ROOT | {"container", "terrain", "verification"},
}
# What the packages inside of a room may import of one another; "" are the modules beside them. A
# method imports no method, and a mode of the viewer no surface. `codec.registry` and `render.modes`
# find theirs by the names in tables.
INSIDE = {
    "codec": {
        "": set(),
        "rapid": set(),
        "predictive": set(),
        "cdf97": set(),
        "cdf53": set(),
        "store": set(),
    },
    "tri": {
        "": {"zerotree", "rqt"},  # `stored`
        "halves": set(),
        "zerotree": set(),
        "dynamic": set(),
        "rqt": set(),
    },
    "render": {
        "": {"look"},
        "scene": set(),
        "modes": {"scene"},
        "paging": {"scene", "modes"},
        "look": {"scene", "paging"},
        "gpu": {"scene", "modes", "paging", "look"},
        "window": {"scene", "modes", "paging", "look", "gpu"},
    },
    "cli": {
        "": {"commands"},  # the package itself and `rio`
        "commands": set(),
    },
}
MOST_SIDE_BY_SIDE = 15  # so many commands there are
# Functions of more lines, without their docstrings: loops of kernels, which cost time when cut.
MOST_LINES, MOST_ARGUMENTS = 70, 10
# How many functions are longer, kernels' loops, or take more: options of a user, or arrays of one
# unit or triangulation, since an array in a tuple counts references in every row.
MOST_LONG, MOST_WIDE = 4, 19
# Entrances: what users start may import all that is above.
ENTRANCES = {"__init__", "__main__", "cli"}
MAY_OPEN_FILES = {"annexes", "raster_io", "container", "cli", "verification", "coding"}


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes_of(path):
    """Return all nodes of a module; to walk takes longer than to look at them."""
    return [*ast.walk(tree_of(path))]


def modules():
    """Return all modules but the plain decoder, which has the format's names and its own rules."""
    return sorted(path for path in PACKAGE.rglob("*.py") if "reference" not in path.parts)


def group_of(path):
    relative = path.relative_to(PACKAGE)
    return relative.parts[0].removesuffix(".py")


def imported_groups(path):
    """Yield the groups a module imports, within functions too."""
    for node in nodes_of(path):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "terrainwave":
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "terrainwave":
                    yield (*alias.name.split("."), "__init__")[1]


def test_every_module_has_a_line():
    assert {group_of(path) for path in modules()} - ENTRANCES <= set(MAY_IMPORT)


def test_modules_import_only_what_their_room_may():
    for path in modules():
        group = group_of(path)
        if group not in ENTRANCES:
            assert set(imported_groups(path)) - {group} <= MAY_IMPORT[group], path


def imported_modules(path):
    """Yield the modules of ours that a module imports, as paths; within functions too."""
    for node in nodes_of(path):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "terrainwave":
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.startswith("terrainwave.")]
        else:
            continue
        for name in names:
            parts = name.split(".")[1:]
            if (module := _module_at(parts) or _module_at(parts[:-1])) is not None:
                yield module


def _module_at(parts):
    path = PACKAGE.joinpath(*parts)
    found = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return found if found.is_file() else None


def package_of(path):
    """Return the package inside of its room that a module is in; "" for those beside packages."""
    parts = path.relative_to(PACKAGE).parts
    return parts[1] if len(parts) > 2 else ""


def test_modules_import_only_the_packages_of_their_room_that_their_own_may():
    for path in modules():
        room, own = group_of(path), package_of(path)
        if room in INSIDE:
            inner = {package_of(it) for it in imported_modules(path) if group_of(it) == room}
            assert inner - {"", own} <= INSIDE[room][own], path


def test_only_gpu_and_the_viewer_import_opengl():
    allowed = PACKAGE / "render" / "gpu", PACKAGE / "render" / "window" / "viewer.py"
    for path in modules():
        if not any(path.is_relative_to(place) for place in allowed):
            for node in nodes_of(path):
                found = _imported_libraries(node) & {"moderngl", "moderngl_window", "pyglet"}
                assert not found, f"{path.relative_to(PACKAGE)}:{node.lineno} imports {found}"


def test_no_imports_lead_in_a_circle():
    """Imports within functions and those for types alone count, too."""
    left = {path: set(imported_modules(path)) - {path} for path in modules()}
    while free := [path for path, others in left.items() if not others & left.keys()]:
        for path in free:
            del left[path]
    # What is left leads to a circle or is one.
    while below := [path for path in left if not any(path in others for others in left.values())]:
        for path in below:
            del left[path]
    assert not left, sorted(str(path.relative_to(PACKAGE)) for path in left)


def test_no_package_is_crowded():
    packages = {path.parent for path in modules()}
    counts = {
        str(package.relative_to(PACKAGE)): len({*package.glob("*.py")} - {package / "__init__.py"})
        for package in packages - {PACKAGE}
    }
    assert max(counts.values()) <= MOST_SIDE_BY_SIDE, counts


def functions_of(tree, owner=""):
    """Yield names, with that of their class, and functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef):
            yield from functions_of(node, f"{node.name}.")
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield (f"{owner}{node.name}" if node.name == "__init__" else node.name), node
            yield from functions_of(node, owner)
        else:
            yield from functions_of(node, owner)


def n_lines_of(function):
    body = function.body
    first = body[1] if ast.get_docstring(function) and len(body) > 1 else body[0]
    return body[-1].end_lineno - first.lineno + 1


def n_arguments_of(function):
    given = function.args
    all_of = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
    return len(all_of) - all_of.count(None)


def test_functions_are_short_and_take_few_arguments():
    functions = [pair for path in modules() for pair in functions_of(tree_of(path))]
    long = {name for name, function in functions if n_lines_of(function) > MOST_LINES}
    wide = {name for name, function in functions if n_arguments_of(function) > MOST_ARGUMENTS}
    assert len(long) <= MOST_LONG, long
    assert len(wide) <= MOST_WIDE, wide


def test_private_attributes_stay_in_their_module():
    """`terrain._decoder` is somebody else's; `self._x`, `cls._x` and named tuples' are not."""
    allowed = {"_replace", "_asdict", "_fields", "_make"}
    for path in modules():
        if path.name in ("compiled.py", "kernel_cache.py", "shortcuts.py"):  # numba's own
            continue
        nodes = nodes_of(path)
        own = {node.attr for node in nodes if _is_own(node)} | {
            node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }
        for node in nodes:
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
        nodes = nodes_of(path)
        own = {id(node.value) for node in nodes if _is_name_of_refiner(node)}
        for node in nodes:
            if isinstance(node, ast.Constant) and node.value in METHODS and id(node) not in own:
                raise AssertionError(f"{path.name}:{node.lineno} has the name {node.value!r}")


# What only some methods and modes can do, and the most lines that ask for it where all of them are
# handled: each is a case that the next method has to know. Headers have remainders of their own.
OF_SYSTEMS = {one.name for one in fields(Method) if isinstance(one.default, bool)}
OF_SYSTEMS |= {"is_tiled", "faithful", "is_faithful", "is_embedded", "goal", "rate", "psnr"}
OF_SYSTEMS = OF_SYSTEMS - {"has_remainders"} | {"has_limit", "is_partwise"}
OWN = ("codec/cdf", "codec/method_options", "names", "render/modes", "tri/rqt", "tri/zerotree")
MOST_ASKED = 67


def test_few_lines_ask_which_system_they_handle():
    asked = {
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in modules()
        if not str(path.relative_to(PACKAGE)).startswith(OWN)
        for node in nodes_of(path)
        if isinstance(node, ast.Attribute) and node.attr in OF_SYSTEMS
        and isinstance(node.ctx, ast.Load)
    }  # fmt: skip
    assert len(asked) <= MOST_ASKED, sorted(asked)


def _is_name_of_refiner(node):
    return isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "name"


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
        for node in nodes_of(path):
            is_open = isinstance(node, ast.Call) and getattr(node.func, "id", "") == "open"
            assert not is_open, f"{path.name}:{node.lineno} opens a file"


HEAVY = (
    "moderngl", "fsspec", "urllib3", "xarray", "zarr", "pyvista", "numba", "rasterio", "pyproj",
    "anywidget", "terrainwave.annexes",
)  # fmt: skip


def test_importing_terrainwave_needs_no_heavy_library_and_no_table():
    code = f"import sys, terrainwave; print({{*{HEAVY!r}}} & {{*sys.modules}})"
    assert python(code).stdout == "set()\n"


@pytest.mark.parametrize(
    "code",
    [
        "import terrainwave as tw; tw.Rapid(), tw.Cdf97(faithful=True), tw.Zerotree(), tw.Rqt()",
        "from terrainwave.cli import main;"
        "main(['compress', '--method', 'cdf97', '--mesh', 'rqt', '--help'])",
    ],
)
def test_options_of_methods_and_their_help_need_no_heavy_library(code):
    heavy = "print(sorted({'numba', 'rasterio', 'numpy', 'pyproj'} & {*sys.modules}))"
    program = f"import atexit, sys; atexit.register(lambda: {heavy}); {code}"
    done = python(program)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
