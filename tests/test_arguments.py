"""Arguments of a wrong type or value are refused in one line: what was found, what was expected."""

import inspect
import math
import re
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

import terrainwave as tw
from terrainwave.arguments import checked_number, checked_whole, number_of
from terrainwave.errors import InvalidArgumentError
from terrainwave.export.mesh import Mesh

HEIGHTS = np.arange(33 * 40, dtype=np.int16).reshape(33, 40)
MESH = Mesh(
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    np.array([[0, 1, 2]], dtype=np.int32),
    origin=(0.0, 0.0, 0.0), error=0.0, crs=None, units=None, attributes={},
)  # fmt: skip

WHOLE = ["1", "a", True, 1.5, math.nan, math.inf, [1], np.array([1, 2]), np.bool_(True), 1j]
NUMBER = ["0.5", "a", True, math.nan, math.inf, [0.5], np.array([1, 2]), np.str_("1"), 1j]
VALUE = [value for value in NUMBER if not isinstance(value, float)]  # nan and inf are values, too
FLAG = ["no", 0, 1, None, np.array([True])]
CHOICE = ["no", 0, 1, np.array([True])]  # None leaves it to the library
WORD = [5, 1.0, True, ["rapid"], "none of them"]
PATH = ["", 5, b"a", ["a"], 1.5]
CALLABLE = [5, "print"]
FOUR = ["abcd", 4, (1, 2, 3), (1, 2, 3, "4"), (1, 2, 3, True), (1, 2, math.nan, 4)]
TWO = ["ab", 4, (1,), ("1", 1), (0, 1), (1.5, 1), (True, 1)]
POINTS = ["ab", 4, [(1, 2, 3)], [("1", "2")], [(1, 2), (3,)], [[[1, 2]]], [(True, False)]]
# What is not checked before it is used: see the test of signatures.
ANYTHING = None

OF_FILES = {"threads": WHOLE, "progress": CALLABLE, "overwrite": FLAG}
OF_RASTERS = {"src": [5, None, ""], "band": WHOLE, "nodata": VALUE, "georeference": FLAG}
OF_CODING = {
    "max_error": NUMBER, "method": WORD, "block": WHOLE, "effort": WORD, "mesh": WORD,
    "strict": FLAG, "stable": FLAG, "verify": FLAG, "threads": WHOLE,
}  # fmt: skip
OF_WINDOWS = {"window": FOUR, "level": WHOLE}
OF_VOIDS = {"on_error": WORD, "voids": WORD}

WRONG = {
    "compress": OF_RASTERS | OF_CODING | OF_FILES | {
        "dst": PATH, "heights_are": WORD, "mesh_error": NUMBER, "measure_meshes": FLAG,
        "height_range": [5, "1,2", (1,), (2, 1), (0, float("nan"))],
        "keep_origin": FLAG, "temp_dir": PATH, "fresh": FLAG, "task_samples": WHOLE,
        "client": ANYTHING, "digest": CHOICE, "bound": WORD,
    },
    "compress_to_bytes": {name: OF_RASTERS[name] for name in ("src", "nodata", "georeference")}
    | OF_CODING
    | {"heights_are": WORD, "digest": CHOICE, "bound": WORD},
    "decompress": OF_WINDOWS | OF_FILES | {
        "src": [5, None, ""], "dst": PATH, "bounds": FOUR, "cog": FLAG, "voids": WORD,
        "quality": NUMBER, "vertical": WORD, "on_error": WORD, "on_lost": CALLABLE,
        "size": ["1025", 5.5, True, "all", [5], 4],
    },
    "patch": {name: OF_RASTERS[name] for name in ("src", "band", "nodata")} | {
        "heights_are": WORD, "path": PATH, "original": [5, ""], "temp_dir": PATH,
        "fresh": FLAG, "threads": WHOLE, "progress": CALLABLE,
    },
    "verify": {
        "twz": PATH, "original": PATH, "max_error": NUMBER, "band": WHOLE, "nodata": VALUE,
        "heights_are": WORD, "part": FLAG, "root": WORD, "window": FOUR, "mesh": FLAG,
        "threads": WHOLE, "progress": CALLABLE,
    },
    "store_meshes": OF_FILES | {
        "src": [5, None, ""], "dst": PATH, "mesh": WORD, "mesh_error": NUMBER, "original": [5, ""],
    },
    "Terrain": {
        "source": [5, None, ""], "cache_bytes": WHOLE, "threads": WHOLE, "native": FLAG,
        "on_error": WORD,
    },
    "Terrain.read": OF_WINDOWS | OF_VOIDS | {
        "bounds": FOUR, "out_shape": TWO, "resampling": WORD, "masked": FLAG, "max_bytes": WHOLE,
    },
    "Terrain.read_with_mask": OF_WINDOWS | OF_VOIDS,
    "Terrain.read_early": OF_WINDOWS | OF_VOIDS | {"quality": NUMBER},
    "Terrain.region": OF_WINDOWS | {"bounds": FOUR},
    "Terrain.checked_window": OF_WINDOWS | {"bounds": FOUR},
    "Terrain.transform_of": OF_WINDOWS,
    "Terrain.coordinates": OF_WINDOWS,
    "Terrain.level_shape": {"level": WHOLE},
    "Terrain.sample": {"points": POINTS, "level": WHOLE, "voids": WORD},
    "Terrain.mesh": OF_WINDOWS | {
        "bounds": FOUR, "max_error": NUMBER, "max_triangles": WHOLE, "optimise": WHOLE,
        "guarantee": FLAG, "progress": CALLABLE,
    },
    "Terrain.block_mesh": {"block": [5, "a", (0, 0)]},
    "Terrain.to_xarray": {"level": WHOLE, "mask_and_scale": FLAG},
    "Terrain.plot": {"bounds": FOUR, "shade": [*NUMBER, -1, 2], "ax": ANYTHING, "cmap": ANYTHING},
    "Terrain.view": {
        "size": TWO, "max_pixel_error": NUMBER, "camera": [5, b"1,2,3,4,5"], "style": [5, "plain"],
        "bounds": FOUR, "mode": WORD, "error": WORD, "detail": NUMBER, "order": [*WHOLE, 3],
        "stepwise": FLAG, "tree": [*WHOLE, 3, 512], "orientation": FLAG, "drape": PATH,
        "exaggeration": [*NUMBER, 0], "radius": [*NUMBER, 0],
    },
    "Mesh.save": {
        "path": PATH, "frame": WORD, "z_scale": NUMBER, "solid": NUMBER, "radius": NUMBER,
        "skirts": [*NUMBER, 0, -1], "up": WORD, "vertical": WORD, "overwrite": FLAG,
        "drape": PATH,
    },
    "save_lods": OF_FILES | {
        "src": [5, None, ""], "dst": PATH, "n_lods": [*WHOLE, 0, 17], "max_error": [*NUMBER, 0],
        "window": FOUR, "bounds": FOUR, "optimise": WHOLE, "frame": WORD, "z_scale": NUMBER,
        "solid": NUMBER, "skirts": [*NUMBER, 0], "radius": NUMBER, "vertical": WORD, "up": WORD,
        "drape": PATH,
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def data():
    return tw.compress_to_bytes(HEIGHTS, max_error=0, method="store", mesh="halves")


@pytest.fixture(scope="module")
def early():
    return tw.compress_to_bytes(HEIGHTS, max_error=1, method="cdf53")


def function_of(name):
    owner, _, attribute = name.rpartition(".")
    return getattr({"": tw, "Terrain": tw.Terrain, "Mesh": Mesh}[owner], attribute)


def call(name, folder, data, early, argument, value):
    """Call a function with one wrong argument; all others are sound."""
    file, target = folder / "made.twz", folder / "new.twz"
    if not file.exists():
        file.write_bytes(data)
    given = {
        "compress": {"src": HEIGHTS, "dst": target},
        "compress_to_bytes": {"src": HEIGHTS},
        "decompress": {"src": file, "dst": folder / ("a.r16" if argument == "size" else "a.tif")},
        "patch": {"path": file, "src": HEIGHTS},
        "verify": {"twz": file},
        "store_meshes": {"src": file, "dst": target},
        "save_lods": {"src": file, "dst": folder / "a.ply"},
        "Terrain": {"source": file},
        "Mesh.save": {"path": folder / "a.ply"},
        "Terrain.read_early": {"quality": 1.0},
        "Terrain.sample": {"points": [(1.0, -1.0)]},
    }.get(name, {})
    if name == "Mesh.save":
        given["self"] = MESH
        if argument == "radius":
            given["frame"] = "local"
    elif name.startswith("Terrain."):
        given["self"] = tw.Terrain(early if name == "Terrain.read_early" else data)
    if argument == "out_shape":
        given["resampling"] = "nearest"
    return function_of(name)(**given | {argument: value})


CASES = [
    (name, argument, value)
    for name, wrong in WRONG.items()
    for argument, values in wrong.items()
    for value in values or ()
]


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_is_refused_with_what_was_found_and_expected(name, tmp_path, data, early):
    for function, argument, value in CASES:
        if function != name:
            continue
        try:
            call(name, tmp_path, data, early, argument, value)
        except InvalidArgumentError as error:
            line = str(error)
        else:
            pytest.fail(f"{argument}={value!r} is taken")
        assert re.fullmatch("[^\n]*found [^\n]+ expected [^\n]+", line), (argument, value, line)
        found, expected = line.split("expected", 1)
        assert found.partition("found ")[2].strip(" ,") not in expected.split(", "), line
    assert {path.name for path in tmp_path.iterdir()} <= {"made.twz"}


@pytest.mark.parametrize("name", WRONG)
def test_each_argument_of_a_public_function_is_in_the_table(name):
    parameters = set(inspect.signature(function_of(name)).parameters) - {"self"}
    assert parameters == set(WRONG[name])


def test_each_public_function_is_in_the_table():
    public = {name for name in tw.__all__ if inspect.isfunction(getattr(tw, name))} - {"open"}
    assert public <= set(WRONG)


def test_numbers_of_numpy_are_numbers(tmp_path):
    file = tmp_path / "a.twz"
    tw.compress(
        HEIGHTS, file, max_error=np.float32(0.5), block=np.int64(64), threads=np.uint8(1),
        band=np.int32(1), nodata=np.float32(-5), method=tw.Store(border_rings=np.int64(1)),
        keep_origin=True, mesh_error=np.array(2), mesh="none",
    )  # fmt: skip
    plain = tmp_path / "b.twz"
    tw.compress(
        HEIGHTS, plain, max_error=0.5, block=64, threads=1, nodata=-5, method="store",
        keep_origin=True, mesh_error=2.0, mesh="none",
    )  # fmt: skip
    assert file.read_bytes() == plain.read_bytes()
    with tw.open(file, threads=np.int64(1), cache_bytes=np.float64(1e6)) as terrain:
        found = terrain.read(
            level=np.int8(-1), out_shape=(np.int64(33), np.int16(40)), max_bytes=np.int64(1 << 20)
        )
        np.testing.assert_array_equal(found, HEIGHTS)
        bounds = np.array(terrain.bounds)
        np.testing.assert_array_equal(terrain.read(bounds=bounds), HEIGHTS)
        window = np.array([1, 2, 3, 4])
        np.testing.assert_array_equal(terrain.read(window), HEIGHTS[1:4, 2:6])
    report = tw.verify(file, max_error=np.float32(1), threads=np.int64(1), band=np.int64(1))
    assert report.bound == 1


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (1, 1), (1.5, 1.5), (np.int64(3), 3), (np.float32(0.5), 0.5), (np.array(2), 2),
        (Fraction(1, 2), 0.5), (Decimal("0.5"), 0.5), ("1", None), (True, None), (None, None),
        (np.bool_(True), None), (np.array([1]), None), (np.ma.masked, None), (1j, None),
    ],
)  # fmt: skip
def test_what_is_a_number(value, number):
    found = number_of(value)
    assert found == number
    assert type(found) in (int, float, type(None))


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: checked_number("rim", "0.5", least=0), "rim the text '0.5', expected a finite"),
        (lambda: checked_number("rim", 10**400), "found rim an int, expected a finite number$"),
        (lambda: checked_number("rim", 0, above=0), "found rim 0, expected a finite number > 0$"),
        (lambda: checked_number("rim", 2, least=0, most=1), "found rim 2, .* number, 0 … 1$"),
        (lambda: checked_whole("rim", 0, least=1), "found rim 0, expected a whole number >= 1$"),
        (lambda: checked_whole("rim", np.ones(3)), r"found rim an array of shape \(3,\), expected"),
        (lambda: checked_whole("rim", ""), "found rim '', expected a whole number$"),
    ],
)
def test_messages_say_what_was_found_and_expected(check, message):
    with pytest.raises(InvalidArgumentError, match=message):
        check()
