"""Do the `Raises` sections of docstrings name what is raised?

The package is read, not run. A function raises what it raises itself and what those it calls do, as
far as names tell whom it calls: functions, classes and methods that it names, and methods whose
name at most `COMMON` classes have.
"""

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from terrainwave import errors

SOURCES = Path(errors.__file__).parent
COMMON = 4
OURS = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, Exception)
}
MADE_BY = ("__init__", "__post_init__", "__new__", "__call__")
# What only an interface says, a function that was passed in, a method whose name many classes have,
# or a table of errors by number.
NOT_SEEN = {
    ("codec.refiner", "DirectRefiner.rows_above", "CorruptStreamError"),
    ("ext.serve.sending", "begun", "TerrainwaveError"),
    ("render.modes.mode", "Mode.build", "CorruptStreamError"),
    ("tri.mesh_options", "MeshOptions.stored", "InvalidArgumentError"),
    ("write.compress", "compress", "ClusterError"),
}
# Nearer is what only other arguments of the function that is called could bring about.
FARTHER = {("export.ellipsoidal", "above_ellipsoid")}


class Place(NamedTuple):
    """A function, as `module` and `name` (of a method: with its class)."""

    module: str
    name: str


class Package:
    """The functions of the package, whom they call and what they raise."""

    def __init__(self):
        self.functions, self.classes = {}, {}  # to (node, class) and to nodes, by place
        self.imports = defaultdict(dict)
        self.methods = defaultdict(list)
        for path in sorted(SOURCES.rglob("*.py")):
            parts = path.relative_to(SOURCES).with_suffix("").parts
            module = ".".join(part for part in parts if part != "__init__")
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in ast.walk(tree):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("terrain"):
                    origin = node.module.partition(".")[2]
                    for name in node.names:
                        self.imports[module][name.asname or name.name] = Place(origin, name.name)
            self._add(module, tree, "")
        self.modules = {place.module for place in self.functions}

    def _add(self, module, parent, owner):
        for node in parent.body:
            name = f"{owner}.{node.name}" if owner and hasattr(node, "name") else ""
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                place = Place(module, name or node.name)
                self.functions[place] = node, owner
                if owner:
                    self.methods[node.name].append(place)
            elif isinstance(node, ast.ClassDef):
                self.classes[module, name or node.name] = node
                self._add(module, node, name or node.name)

    def called(self, module, name):
        """Return the functions that run when a name of a module is called."""
        place = Place(module, name)
        if place in self.functions:
            return [place]
        if place in self.classes:
            return [found for made in MADE_BY for found in self.method(module, name, made)]
        return self.called(*self.imports[module][name]) if name in self.imports[module] else []

    def method(self, module, owner, name):
        """Return a method of a class, or of those it inherits from."""
        if (module, owner) not in self.classes:
            if owner not in self.imports[module]:
                return []
            return self.method(*self.imports[module][owner], name)
        place = Place(module, f"{owner}.{name}")
        if place in self.functions:
            return [place]
        bases = [base.id for base in self.classes[place[0], owner].bases if hasattr(base, "id")]
        return [found for base in bases for found in self.method(module, base, name)]

    def _of_attribute(self, module, owner, node):
        value, name = node.value, node.attr
        if isinstance(value, ast.Name) and value.id in ("self", "cls") and owner:
            return self.method(module, owner, name)
        if isinstance(value, ast.Name) and value.id in self.imports[module]:
            origin = self.imports[module][value.id]
            inside = ".".join(part for part in origin if part)
            return (
                self.called(inside, name) if inside in self.modules else self.method(*origin, name)
            )
        if len(self.methods[name]) <= COMMON or ast.unparse(value) == "super()":
            return self.methods[name]
        return []

    @cache  # noqa: B019, one package
    def directly(self, place):
        """Return which of our exceptions a function names, and whom it calls."""
        node, owner = self.functions[place]
        named, calls = set(), set()
        for part in ast.walk(node):
            if isinstance(part, ast.Name):
                named |= {part.id} & OURS.keys()
                calls.update(self.called(place.module, part.id))
            elif isinstance(part, ast.Attribute):
                calls.update(self._of_attribute(place.module, owner, part))
        return named, calls

    def raised(self, place):
        """Return what a function raises, with how many calls lie between."""
        found, seen, ring = {}, {place}, [place]
        distance = 0
        while ring:
            following = []
            for one in ring:
                named, calls = self.directly(one)
                for name in named:
                    found.setdefault(name, distance)
                following += calls - seen
                seen |= calls
            ring, distance = following, distance + 1
        return found


def told(docstring):
    """Return the exceptions of ours that a docstring's `Raises` section names."""
    section = re.search(r"^Raises\n-+\n(.*?)(?=\n\n\w+\n---|\Z)", docstring or "", re.S | re.M)
    lines = section[1].splitlines() if section else []
    names = [name for line in lines if not line.startswith(" ") for name in line.split(", ")]
    return [name for name in names if name in OURS]


@pytest.fixture(scope="module")
def package():
    return Package()


@pytest.fixture(scope="module")
def documented(package):
    found = {place: told(ast.get_docstring(node)) for place, (node, _) in package.functions.items()}
    documented = {place: names for place, names in found.items() if names}
    assert len(documented) > 150
    return documented


@pytest.mark.full
def test_each_exception_that_a_docstring_names_is_raised(package, documented):
    wrong = {
        (*place, name)
        for place, names in documented.items()
        for name in set(names) - package.raised(place).keys()
    }
    assert wrong == NOT_SEEN


def test_arguments_that_cannot_be_are_told_apart_from_heights(package, documented):
    """Where both may be raised, a docstring names at least the one that lies nearer."""
    both = ("InvalidArgumentError", "InvalidHeightsError")
    wrong = []
    for place, names in documented.items():
        far = {name: number for name, number in package.raised(place).items() if name in both}
        nearest = [name for name in far if far[name] == min(far.values())]
        nearest += [name for name in both if (*place, name) in NOT_SEEN]
        if place not in FARTHER and set(names) & set(both) and not set(names) & set(nearest):
            wrong.append(f"{place.module}: {place.name} raises {' or '.join(nearest)}")
    assert not wrong


def test_what_a_function_raises_itself_is_named_if_anything_is(package, documented):
    wrong = []
    for place, names in documented.items():
        node, _ = package.functions[place]
        for part in ast.walk(node):
            call = part.exc if isinstance(part, ast.Raise) else None
            name = getattr(getattr(call, "func", None), "id", None)
            if name in OURS and not any(issubclass(OURS[name], OURS[own]) for own in names):
                wrong.append(f"{place.module}: {place.name} raises {name}, line {part.lineno}")
    assert not wrong
