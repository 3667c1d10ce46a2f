"""`stable`: what was decompressed and is compressed again stays as it is."""

import numpy as np
import pytest
from cases import some
from strategies import terrain_like, write_geotiff
from twz import twz_bytes

import terrainwave
from terrainwave import Cdf97
from terrainwave.container.header import HAS_VOIDS
from terrainwave.errors import InvalidArgumentError
from terrainwave.verification.heights import verify
from terrainwave.write.compress import compress
from terrainwave.write.compress_options import Options


def bits(heights):
    return np.ascontiguousarray(heights).view(f"u{heights.itemsize}")


def heights_of(dtype):
    """Return hills with a void of -9999."""
    scale = 1.7 if np.dtype(dtype).kind == "f" else 1
    heights = (terrain_like(75, 68, "float64") * scale).astype(dtype)
    heights[20:30, 40:50] = -9999
    return heights


@pytest.mark.few(3)
@pytest.mark.parametrize("method", some(["rapid", "predictive", "store", "cdf97"], 2))
@pytest.mark.parametrize(
    ("dtype", "max_error"), [("float32", 0.1), ("float64", 3), ("int16", 2), ("int32", 5.5)]
)
def test_ten_generations_of_whole_files_are_the_first(dtype, max_error, method):
    heights = heights_of(dtype)
    options = dict(max_error=max_error, nodata=-9999, stable=True, method=method)
    data = twz_bytes(heights, **options)
    with terrainwave.open(data) as terrain:
        first = terrain.read()
        assert 0.5 * max_error < np.abs(first - heights.astype("f8")).max() <= max_error
        assert terrain.max_error == max_error
        assert 0.9 * (max_error - 1) < terrain.effective_error <= max_error
        assert terrain.header.features == HAS_VOIDS  # fixed steps need no bit
    parts = [first[:31], first[31:]]
    for _ in range(2):
        for at, part in enumerate(parts):
            with terrainwave.open(twz_bytes(part, **options)) as terrain:
                parts[at] = terrain.read()
    np.testing.assert_array_equal(bits(np.concatenate(parts)), bits(first))


def test_the_bound_is_of_heights_after_scale(tmp_path):
    heights = heights_of("int16")
    raster = write_geotiff(tmp_path / "dem.tif", heights, nodata=-9999, bands={"scales": 0.1})
    compress(raster, tmp_path / "dem.twz", max_error=0.5, stable=True, block=32)
    report = verify(tmp_path / "dem.twz", raster, mesh=True)
    assert report.problems == ()
    assert report.is_strict
    assert report.errors.max_error == pytest.approx(0.5)
    assert report.effective_error == pytest.approx(0.5)


def test_heights_without_a_step_make_the_file_exact_and_a_note_says_so(tmp_path):
    heights = heights_of("float32")
    heights[3, 4] = 1e9
    target = tmp_path / "dem.twz"
    result = compress(heights, target, max_error=0.1, nodata=-9999, stable=True)
    assert result.effective_error == 0
    assert any("the file keeps all heights exactly" in note for note in result.notes)
    with terrainwave.open(target) as terrain:
        np.testing.assert_array_equal(terrain.read(), heights)


def test_a_bound_below_the_spacing_of_floats_is_kept_by_every_bit():
    heights = heights_of("float32") / np.float32(3)
    with terrainwave.open(twz_bytes(heights, max_error=1e-25, stable=True)) as terrain:
        np.testing.assert_array_equal(bits(terrain.read()), bits(heights))


@pytest.mark.parametrize(
    ("options", "found"),
    [
        (dict(stable=True), "stable without max_error"),
        (dict(stable=True, max_error=1, method="cdf53"), "stable and method cdf53"),
        (dict(stable=True, max_error=1, method=Cdf97(faithful=True)), "stable and faithful"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options, found):
    with pytest.raises(InvalidArgumentError, match=found):
        Options(**options)
