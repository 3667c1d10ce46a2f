import statistics
import sys
import time
from dataclasses import replace

import imagecodecs
import numpy as np
import pytest
import rasterio
import rasterio.shutil
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import codecs, peers
from benchmarks.codecs import best_trial, compare, time_trials
from benchmarks.common import repeat_option_names
from benchmarks.peers import (
    dequantize_indices,
    float_bound,
    make_codecs,
    quantize_indices,
    snap_to_grid,
)
from benchmarks.rasters import Raster, detect_quantum, make_forms, mask_bytes, void_fills


def make_raster(heights, mask=None, nodata=None):
    mask = np.ones(heights.shape, bool) if mask is None else mask
    quantum = detect_quantum(heights[mask])
    return Raster("test", heights, mask, quantum, nodata, None, None)


def ground(dtype, quantum, seed):
    """Some hills, on a grid if `quantum` is not 0."""
    walk = np.random.default_rng(seed).normal(0, 9, (13, 17)).cumsum(0).cumsum(1)
    heights = np.rint(walk / quantum) * quantum if quantum else walk
    return make_raster(heights.astype(dtype))


@pytest.mark.parametrize(
    ("values", "quantum"),
    [([1.0, 2.0], 1.0), ([1.5, 2.0], 0.5), ([0.01, 7.13], 0.01), ([0.1234567, 3.0], 0.0)],
)
def test_quantum_is_the_largest_that_all_heights_are_multiples_of(values, quantum):
    assert detect_quantum(np.array(values, np.float32)) == quantum


def test_integers_have_quantum_one_even_where_all_are_even():
    assert detect_quantum(np.array([2, 4], np.int16)) == 1.0


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


def test_step_on_whole_metres_is_twice_the_bound_plus_one():
    assert quantize_indices(ground("int16", 1.0, 1), 3.0).step == 7.0


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


def test_nan_among_decoded_heights_is_a_problem():
    raster = ground("float32", 0.0, 3)
    decoded = raster.heights.copy()
    decoded[0, 0] = np.nan
    assert compare(raster, decoded, 1e9, check_voids=False).problem


def test_valid_sample_that_decodes_to_nodata_is_a_problem():
    heights = np.array([[-1, 5], [0, 7]], np.int16)
    raster = make_raster(heights, heights != -1, nodata=-1)
    decoded = np.array([[-1, 5], [-1, 7]], np.int16)
    assert compare(raster, decoded, 1.0, check_voids=True).problem == "MASK DIFFERS"


def test_allowance_exists_on_decimal_grids_of_floats_only():
    assert ground("float32", 0.01, 4).slack > 0
    assert ground("float32", 0.5, 4).slack == 0
    assert ground("float32", 0.0, 4).slack == 0
    assert ground("int16", 1.0, 4).slack == 0


def test_fills_change_void_samples_only_and_stay_on_the_grid():
    raster = ground("int16", 1.0, 5)
    mask = raster.mask.copy()
    mask[3:9, 4:12] = False
    raster = replace(raster, mask=mask)
    fills = dict(void_fills(raster))
    assert sorted(fills) == ["constant", "nearest", "smooth"]
    for filled in fills.values():
        np.testing.assert_array_equal(filled.heights[mask], raster.heights[mask])
        assert filled.heights.dtype == np.int16
    assert mask_bytes(mask) > 0


def test_raster_without_voids_has_one_fill_and_a_free_mask():
    raster = ground("int16", 1.0, 6)
    assert [name for name, _ in void_fills(raster)] == ["none"]
    assert mask_bytes(raster.mask) == 0


def test_values_after_a_list_option_each_get_its_name():
    args = ["dir", "--max-error", "0", "1", "--crop", "9", "--max-error", "3", "--", "more"]
    expected = ["dir", "--max-error", "0", "--max-error", "1", "--crop", "9"]
    expected += ["--max-error", "3", "more"]
    assert repeat_option_names(args, {"--max-error"}) == expected


def test_list_option_without_a_value_is_left_for_click_to_complain_about():
    assert repeat_option_names(["--max-error"], {"--max-error"}) == ["--max-error"]


# What is timed: the calls of a codec's own user.


def timed_tasks(monkeypatch, codec, raster, max_error):
    """Return what the clock of `time_trials` covers: encoding and decoding."""
    trial = best_trial(codec, make_forms(raster), max_error)
    assert not trial.errors.problem
    found = []
    monkeypatch.setattr(codecs.common, "take_turns", lambda tasks, *_, **__: found.extend(tasks()))
    time_trials([trial], 1)
    return found


def calls_of(task):
    """Return what a task returns, and the functions that it calls directly, by name."""
    called = []

    def note(frame, event, argument):
        if event == "call" and frame.f_back is not None and frame.f_back.f_code in own:
            called.append(frame.f_code.co_name)
        if event == "c_call" and frame.f_code in own:
            called.append(argument.__name__)

    own = {getattr(task, "func", task).__code__}
    sys.setprofile(note)
    try:
        result = task()
    finally:
        sys.setprofile(None)
    return result, called


@pytest.mark.parametrize("name", ["cog", "cog-float32"])
def test_a_cog_is_timed_by_the_calls_of_its_user_and_nothing_else(monkeypatch, tmp_path, name):
    (codec,) = make_codecs([name], [], tmp_path)
    encode, decode = timed_tasks(monkeypatch, codec, ground("int16", 1.0, 7), 1.0)
    copied = []
    monkeypatch.setattr(peers.rasterio.shutil, "copy", lambda *_, **more: copied.append(more))
    path, called = calls_of(encode)
    assert [call for call in called if not call.startswith("__")] == ["<lambda>"]
    assert [(more["driver"], more["COMPRESS"]) for more in copied] == [("COG", "LERC_ZSTD")]
    monkeypatch.undo()

    class Source:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def read(self, band):
            return ("what GDAL read", band)

    monkeypatch.setattr(peers.rasterio, "open", lambda opened: Source() if opened == path else None)
    result, called = calls_of(decode)
    # What GDAL returns is the result: no conversion, no rounding, no copy.
    assert result == ("what GDAL read", 1)
    assert called == ["<lambda>", "__enter__", "read", "__exit__"]


@pytest.mark.parametrize("name", ["sz3", "sperr", "jxl-e7"])
def test_codecs_of_arrays_are_timed_by_their_own_call_alone(monkeypatch, tmp_path, name):
    kind = {"sz3": "sz3", "sperr": "sperr", "jxl-e7": "jpegxl"}[name]
    (codec,) = make_codecs([name], [], tmp_path)
    raster = ground("int16", 1.0, 8)
    encode, decode = timed_tasks(monkeypatch, codec, raster, 1.0)
    given = []
    for what in ("encode", "decode"):
        monkeypatch.setattr(
            imagecodecs,
            f"{kind}_{what}",
            lambda array, **_: given.append(array) or ("made of", array),
        )
    assert encode() == ("made of", given[0])
    assert given[0].shape == raster.heights.shape  # made before: an array of the codec's type
    assert decode()[1] is given[1]


@pytest.mark.full
@pytest.mark.large
@pytest.mark.parametrize("name", ["cog", "sz3"])
def test_a_timed_read_takes_what_a_bare_one_takes(monkeypatch, tmp_path, name):
    rows, cols = np.indices((2048, 2048))
    waves = 300 * np.sin(rows / 40) + 200 * np.cos(cols / 33 + rows / 90)
    raster = make_raster(np.rint(waves).astype(np.int16))
    (codec,) = make_codecs([name], [], tmp_path)
    _, decode = timed_tasks(monkeypatch, codec, raster, 1.0)

    def bare():
        if name == "sz3":
            imagecodecs.sz3_decode(decode.args[0], shape=raster.heights.shape, dtype=np.float32)
            return
        with rasterio.open(decode.args[0]) as source:
            source.read(1)

    def ratio():
        taken = {decode: [], bare: []}
        for _ in range(11):
            for task, seconds in taken.items():
                start = time.process_time()
                task()
                seconds.append(time.process_time() - start)
        return statistics.median(taken[decode]) / statistics.median(taken[bare])

    # On a machine that does other work one comparison of the same code can be off.
    assert min(abs(ratio() - 1) for _ in range(4)) <= 0.1
