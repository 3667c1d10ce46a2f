from dataclasses import replace

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.codecs import compare
from benchmarks.peers import (
    PEERS,
    dequantize_indices,
    float_bound,
    quantize_indices,
    snap_to_grid,
)
from benchmarks.rasters import Raster, detect_quantum


def make_raster(heights, mask=None, nodata=None):
    mask = np.ones(heights.shape, bool) if mask is None else mask
    quantum = detect_quantum(heights[mask])
    return Raster("test", heights, mask, quantum, nodata, None, None)


def ground(dtype, quantum, seed):
    """Some hills, on a grid if `quantum` is not 0."""
    walk = np.random.default_rng(seed).normal(0, 9, (13, 17)).cumsum(0).cumsum(1)
    heights = np.rint(walk / quantum) * quantum if quantum else walk
    return make_raster(heights.astype(dtype))


@given(
    kind=st.sampled_from([("int16", 1.0), ("float32", 0.01), ("float32", 0.0)]),
    max_error=st.sampled_from([0.1, 0.5, 1.0, 3.0, 10.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_indices_decode_within_the_bound(kind, max_error, seed):
    raster = ground(*kind, seed)
    indices = quantize_indices(raster, max_error)
    decoded = dequantize_indices(indices.values, indices.first, indices.step, raster.heights.dtype)
    assert indices.values.min() >= 0
    assert not compare(raster, decoded, max_error, check_voids=False).problem


@pytest.mark.parametrize(("quantum", "nodata"), [(0.01, None), (0.01, -9999.0), (0.0, np.nan)])
@pytest.mark.parametrize("name", [name for name in PEERS if "steps" in name])
def test_cogs_of_steps_keep_bound_and_voids_and_say_their_scale(tmp_path, name, quantum, nodata):
    raster = ground("float32", quantum, seed=3)
    if nodata is not None:
        mask = np.ones(raster.heights.shape, bool)
        mask[2:5, 3:9] = False
        heights = np.where(mask, raster.heights, np.float32(nodata))
        raster = replace(raster, heights=heights, mask=mask, nodata=nodata)
    codec = PEERS[name](tmp_path)
    calls = codec.calls(raster, 0.05, 1.0)
    stored = calls.encode()
    decoded = calls.heights(calls.decode(stored))
    assert not compare(raster, decoded, 0.05, check_voids=nodata is not None).problem
    with rasterio.open(stored) as cog:
        scaled = cog.read(1) * cog.scales[0] + cog.offsets[0]
    np.testing.assert_allclose(scaled[raster.mask], decoded[raster.mask], atol=1e-4)


def test_jpeg_xl_counts_the_steps_of_valid_heights():
    heights = np.array([[0, 5000, -9999]], np.float32)
    raster = replace(
        make_raster(heights), mask=heights >= 0, quantum=0.0, nodata=-9999.0
    )  # 15,000 m with the void
    refused = [PEERS["jxl-e9"](None).refuses(raster, bound) for bound in (0.1, 0.02)]
    assert refused == ["", "more than 65536 indices"]


@given(max_error=st.sampled_from([0.0, 0.5, 1.0, 10.0]), seed=st.integers(0, 99))
def test_float_bound_is_kept_after_rounding_back(max_error, seed):
    raster = ground("int16", 1.0, seed)
    bound = float_bound(raster, max_error)
    sign = np.where(np.indices(raster.heights.shape).sum(0) % 2, 1.0, -1.0)
    decoded = snap_to_grid((raster.heights + sign * bound).astype(np.float32), raster)
    assert not compare(raster, decoded, max_error, check_voids=False).problem


def test_one_sample_above_the_bound_is_a_problem():
    raster = ground("int16", 1.0, 2)
    decoded = raster.heights.copy()
    decoded[5, 5] += 4
    assert compare(raster, decoded, 3.0, check_voids=False).problem == "BOUND VIOLATED: 4.0"


def test_valid_sample_that_decodes_to_nodata_is_a_problem():
    heights = np.array([[-1, 5], [0, 7]], np.int16)
    raster = make_raster(heights, heights != -1, nodata=-1)
    decoded = np.array([[-1, 5], [-1, 7]], np.int16)
    assert compare(raster, decoded, 1.0, check_voids=True).problem == "MASK DIFFERS"
