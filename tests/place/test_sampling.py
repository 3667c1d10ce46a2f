"""`Terrain.sample` around the globe, against linear interpolation by hand; what `info` says."""

import io
import sys

import numpy as np
import pytest
import rasterio
from place.crs_cases import CF_POLE, GRIB
from twz import twz_bytes

from terrainwave.terrain import Terrain


def terrain_of(heights, transform, crs):
    with rasterio.open(
        "", "w+", driver="MEM", height=heights.shape[0], width=heights.shape[1], count=1,
        dtype="float32", transform=rasterio.Affine(*transform), crs=crs,
    ) as dataset:  # fmt: skip
        dataset.write(heights.astype(np.float32), 1)
        data = twz_bytes(dataset, max_error=0, mesh="none")
    return Terrain(io.BytesIO(data), threads=1)


def around(n_cols, first, crs="EPSG:4326"):
    """Return a terrain of the whole turn: column k of every row is k * k high."""
    step = 360 / n_cols
    heights = np.tile(np.arange(n_cols) ** 2.0, (5, 1))
    return terrain_of(heights, (step, 0, first, 0, -step, 2.5 * step), crs)


@pytest.mark.parametrize("first", [-180.0, 0.0, -5.0])
@pytest.mark.parametrize("turns", [-2, 0, 1])
def test_a_raster_around_the_globe_goes_on_from_its_last_column(first, turns):
    terrain = around(36, first)
    # column 35.25: a quarter from the last column, 35, to the first one
    place = [(first + 10 * (35.25 + 0.5) + 360 * turns, 0.0)]
    assert terrain.sample(place) == pytest.approx([0.75 * 35**2], abs=1e-3)
    # the first quarter of the first pixel lies beyond its sample, too
    place = [(first + 10 * 0.25 + 360 * turns, 0.0)]
    assert terrain.sample(place) == pytest.approx([0.25 * 35**2], abs=1e-3)


def test_a_coarse_level_closes_around_the_globe():
    terrain = around(37, -180.0)
    # level -2 has columns 0, 2, … 36 of 37: from 36 to 37, which is 0, half a step of it
    step = 360 / 37
    place = [(-180 + step * (36.5 + 0.5), 0.0)]
    assert terrain.sample(place, level=-2) == pytest.approx([36**2 / 2], abs=1e-3)


def test_longitudes_of_a_turned_pole_wrap_too():
    terrain = terrain_of(np.ones((9, 9)), (0.1, 0, 359.6, 0, -0.1, 0.4), CF_POLE)
    assert terrain.sample([(0.0, 0.0), (-360.0, 0.0), (360.0, 0.0)]) == pytest.approx([1, 1, 1])


def test_sampling_needs_no_pyproj(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert around(36, -180.0, GRIB).sample([(175.0, 0.0), (535.0, 0.0)]) == pytest.approx(1225)
