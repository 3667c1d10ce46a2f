"""Is max |decoded - original| <= max_error on everything, and does every mask come back?"""

import re
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import RASTER_DTYPES, terrain_like, valid_masks
from twz import twz_bytes

from terrainwave.errors import InvalidHeightsError
from terrainwave.names import METHODS
from terrainwave.terrain import Terrain

# The lowest of int16, alone, looks like a mark of voids.
pytestmark = pytest.mark.filterwarnings("ignore::terrainwave.errors.TerrainwaveWarning")

MAX_ERRORS = (0, 0.1, 0.3, 0.5, 1, 3, 10, 1e6)


@dataclass
class Case:
    """A raster, which of its samples are valid, and how its voids are declared."""

    heights: np.ndarray
    valid: np.ndarray
    nodata: float | int | None = None
    is_masked: bool = False

    @property
    def source(self):
        return np.ma.MaskedArray(self.heights, ~self.valid) if self.is_masked else self.heights


@st.composite
def special_heights(draw, shape):
    """Draw ten million up, all of int32, decimals, terrain, or noise on no grid."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["offset", "int32", "decimals", "terrain", "noise"]))
    if kind == "offset":
        dtype = draw(st.sampled_from(["int32", "float32"]))
        return (10_000_000 + rng.integers(-50, 50, shape)).astype(dtype)
    if kind == "int32":
        return rng.choice([-(2**31), -1, 0, 2**31 - 1], shape).astype("int32")
    if kind == "decimals":
        dtype = draw(st.sampled_from(["float32", "float64"]))
        return (rng.integers(-3000, 3000, shape) / 10).astype(dtype)
    if kind == "terrain":
        return terrain_like(*shape, dtype=draw(st.sampled_from(["int16", "float32"])))
    return rng.normal(1e5, 1e3, shape).astype("float32")


@st.composite
def cases(draw, shapes):
    shape = draw(shapes)
    dtypes = st.sampled_from(RASTER_DTYPES).map(np.dtype)
    plain = dtypes.flatmap(lambda dtype: plain_heights(shape, dtype))
    return draw(with_voids(draw(plain | special_heights(shape))))


@st.composite
def plain_heights(draw, shape, dtype):
    """Draw what `strategies.heights_arrays` does, at a given shape."""
    row, col = np.indices(shape)
    limits = np.iinfo(dtype) if dtype.kind in "iu" else None
    low = max(limits.min, -(2**28)) if limits else -1e4
    high = min(limits.max, 2**28) if limits else 1e4
    kind = draw(st.sampled_from(["constant", "ramp", "spike", "checkerboard", "noise"]))
    if kind == "constant":
        return np.full(shape, draw(st.integers(int(low), int(high)))).astype(dtype)
    if kind == "ramp":
        return (3 * row + 2 * col).clip(low, high).astype(dtype)
    if kind == "checkerboard":
        return np.where((row + col) % 2, low, high).astype(dtype)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if kind == "noise":
        return rng.uniform(low, high, shape).astype(dtype)
    heights = np.full(shape, low)
    heights.flat[rng.integers(heights.size)] = high
    return heights.astype(dtype)


@st.composite
def with_voids(draw, heights):
    """Declare no voids, a nodata value out of or inside the range, NaN, or a mask."""
    whole = np.ones(heights.shape, dtype=bool)
    kind = draw(st.sampled_from(["none", "nodata", "taken nodata", "nan", "mask"]))
    if kind == "none":
        return Case(heights, whole)
    valid = draw(valid_masks(heights.shape))
    heights = heights.copy()
    is_float = heights.dtype.kind == "f"
    if kind == "mask" and not is_float:
        return Case(heights, valid, is_masked=True)
    if kind == "nan" and is_float:
        heights[~valid] = np.nan
        return Case(heights, valid)
    # Inside the range of the heights: the value of one of them, or one between.
    values = heights.astype("float64")
    nodata = draw(
        st.sampled_from([values.flat[0], np.floor(values.mean())])
        if kind == "taken nodata"
        else st.just(-9999.0 if is_float else float(np.iinfo(heights.dtype).max))
    )
    nodata = nodata if is_float else int(nodata)
    heights[~valid] = nodata
    return Case(heights, heights != heights.dtype.type(nodata), nodata)


def encode(case, max_error, **options):
    """Return (file, bound); where the bound cannot be kept, that of the one the message names."""
    try:
        return twz_bytes(case.source, max_error=max_error, nodata=case.nodata, **options), max_error
    except InvalidHeightsError as error:
        advised = float(re.search(r"expected at least ([0-9.e+-]+)", str(error)).group(1))
    assert advised > max_error
    assert case.heights.dtype.kind == "f" or case.heights.dtype == "int32"
    return twz_bytes(case.source, max_error=advised, nodata=case.nodata, **options), advised


def check(case, data, max_error, *, strict=False):
    with Terrain(data, threads=1) as terrain:
        heights, valid = terrain.read_with_mask()
        plain = terrain.read()
        shapes = [terrain.read(level=level).shape for level in range(terrain.n_levels)]
        assert shapes == [terrain.level_shape(level) for level in range(terrain.n_levels)]
        assert terrain.effective_error <= max_error
        stated = terrain.effective_error
    np.testing.assert_array_equal(valid, case.valid)
    assert heights.dtype == case.heights.dtype
    np.testing.assert_array_equal(plain, heights)
    if valid.any():
        original = case.heights[valid].astype("float64")
        # On a grid of decimals the bound holds for the numbers; floats next to them may differ by
        # one spacing more.
        slack = np.spacing(np.abs(case.heights[valid]).max()) if plain.dtype.kind == "f" else 0
        largest = np.abs(heights[valid].astype("float64") - original).max()
        assert largest <= stated + slack
        if strict:
            assert largest <= max_error
        if strict and plain.dtype.kind == "f":
            assert float(np.abs(heights[valid] - case.heights[valid]).max()) <= max_error
    if case.nodata is not None:
        reads_as_void = plain == plain.dtype.type(case.nodata)
        np.testing.assert_array_equal(reads_as_void, ~case.valid)
    elif plain.dtype.kind == "f":
        np.testing.assert_array_equal(np.isnan(plain), ~case.valid)


of_units = st.fixed_dictionaries(
    {
        "block": st.sampled_from([32, 64]),
        "border_rings": st.sampled_from([1, 3]),
        "method": st.sampled_from(["cdf97", "store"]),
        "effort": st.sampled_from(["fast", "default"]),
        "strict": st.booleans(),
    }
)
of_tiles = st.fixed_dictionaries(
    {"block": st.sampled_from([32, 64]), "method": st.just("cdf53"), "strict": st.booleans()}
)
of_faithful = st.fixed_dictionaries(
    {
        "border_rings": st.sampled_from([1, 3]),
        "method": st.just("cdf97"),
        "faithful": st.just(True),
    }
)
options = of_units | of_tiles | of_faithful
tiny = st.tuples(st.integers(1, 6), st.integers(1, 6))
sides = st.sampled_from([1, 2, 3, 31, 32, 33, 34, 63, 64, 65, 66, 129, 130, 150])
medium = st.tuples(sides, sides) | st.tuples(st.just(1), st.integers(1, 300))


@given(cases(tiny), st.sampled_from(MAX_ERRORS), options)
def test_the_bound_and_the_mask_hold_on_tiny_rasters(case, max_error, options):
    data, bound = encode(case, max_error, **options)
    check(case, data, bound, strict=options.get("strict", False))


@pytest.mark.large
@settings(max_examples=5 * settings.default.max_examples)
@given(cases(medium), st.sampled_from(MAX_ERRORS), options)
def test_the_bound_and_the_mask_hold_on_several_blocks(case, max_error, options):
    data, bound = encode(case, max_error, **options)
    check(case, data, bound, strict=options.get("strict", False))


@pytest.mark.full
@settings(max_examples=3 * settings.default.max_examples)
@given(
    cases(tiny | medium),
    st.sampled_from(MAX_ERRORS),
    st.sampled_from(["rapid", "predictive"]),
    st.sampled_from([1, 3]),
    st.booleans(),
)
def test_the_bound_and_the_mask_hold_by_the_methods_of_the_default(
    case, max_error, method, rings, strict
):
    rings = rings if METHODS[method].has_rings else 1
    options = {"method": method, "border_rings": rings, "block": 32, "strict": strict}
    data, bound = encode(case, max_error, **options)
    check(case, data, bound, strict=strict)


def case_of(heights, nodata=None):
    valid = np.ones(heights.shape, dtype=bool) if nodata is None else heights != nodata
    return Case(heights, valid, nodata)


@pytest.mark.parametrize("method", ["cdf97", "cdf53", "store"])
def test_nodata_next_to_valid_heights_is_never_decoded(method):
    heights = np.array([[4, 6, 5], [5, 4, 6], [3, 5, 7]], dtype="int16")
    check(case_of(heights, 5), twz_bytes(heights, max_error=2, nodata=5, method=method), 2)


@pytest.mark.parametrize("method", ["cdf97", "cdf53", "store"])
def test_nodata_on_a_decimal_grid_is_never_decoded(method):
    heights = np.array([[0.0, 0.1, 0.2], [0.2, 0.0, 0.1], [0.1, 0.2, 0.3]], dtype="float32")
    valid = heights != np.float32(0.1)
    data = twz_bytes(heights, max_error=0.2, nodata=0.1, method=method)
    check(Case(heights, valid, 0.1), data, 0.2)


@pytest.mark.parametrize("max_error", [1, 2, 3])
def test_heights_that_give_way_to_nodata_are_within_the_bound_stated(max_error):
    heights = np.random.default_rng(4).integers(0, 11, (40, 40)).astype("int16")
    data = twz_bytes(heights, max_error=max_error, nodata=5, method="cdf53")
    with Terrain(data) as terrain:
        decoded, valid = terrain.read_with_mask()
        worst = np.abs(decoded - heights.astype(float))[valid].max()
        assert worst <= terrain.effective_error <= max_error


@pytest.mark.few(8)
@pytest.mark.parametrize("method", ["cdf97", "cdf53", "store"])
@pytest.mark.parametrize("max_error", [256, 300, 400, 500, 600])
def test_nodata_at_the_end_of_int32_is_never_decoded(method, max_error):
    # p is 8 here: 2^31 - 1 and 2^31 - 2 round to the same quantum.
    top = 2**31 - 1
    heights = np.array([[top, top - 1, top - 2], [-top, top - 5, top - 3]], dtype="int32")
    data = twz_bytes(heights, max_error=max_error, nodata=top, method=method)
    check(case_of(heights, top), data, max_error)


@pytest.mark.parametrize("max_error", [256, 260, 1000])
def test_all_of_int32_keeps_the_bound(max_error):
    rng = np.random.default_rng(0)
    heights = rng.choice([-(2**31), 2**31 - 1], (9, 8)) + np.sign(rng.normal(size=(9, 8)))
    heights = np.clip(heights, -(2**31), 2**31 - 1).astype("int32")
    check(case_of(heights), twz_bytes(heights, max_error=max_error), max_error)


@pytest.mark.few(4)
@pytest.mark.large
@pytest.mark.parametrize("max_error", [0, 3])
@pytest.mark.parametrize("shape", [(1, 3000), (3000, 2), (300, 300)])
def test_longer_rasters_keep_the_bound(shape, max_error):
    case = case_of(terrain_like(*shape))
    check(case, twz_bytes(case.heights, max_error=max_error), max_error)


@pytest.mark.parametrize("max_error", [Fraction(1, 2), Decimal("0.5"), np.float32(0.5)])
def test_a_bound_may_be_any_number(max_error):
    data = twz_bytes(np.array([[0.0, 0.3], [7.1, 9.9]]), max_error=max_error, method="store")
    with Terrain(data) as terrain:
        assert terrain.max_error == 0.5
