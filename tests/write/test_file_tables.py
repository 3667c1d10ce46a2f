"""Files whose header carries fitted tables."""

import numpy as np
import pytest

import terrainwave
from terrainwave.codec.predictive.file_tables import parse_file_tables
from terrainwave.codec.rapid import file_tables as rapid_parameters
from terrainwave.container.header import Header


def rough(shape, seed=0):
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    waves = 90 * np.sin(rows / 1.7) * np.cos(cols / 1.9) + 300 * np.sin(rows / 40)
    return np.rint(waves + rng.normal(0, 2, shape)).astype(np.int16)


def header_of(path) -> Header:
    with terrainwave.Terrain(path) as terrain:
        return terrain.header


@pytest.mark.large
@pytest.mark.parametrize("max_error", [0, 4])
def test_a_file_with_fitted_tables_keeps_the_bound_on_any_number_of_threads(tmp_path, max_error):
    heights = rough((420, 390))
    paths = [tmp_path / f"{threads}.twz" for threads in (1, 3)]
    for threads, path in zip((1, 3), paths, strict=True):
        terrainwave.compress(
            heights, path, max_error=max_error, threads=threads, method="predictive"
        )
    assert paths[0].read_bytes() == paths[1].read_bytes()
    header = header_of(paths[0])
    assert any(parse_file_tables(header.file_tables).stencils.values())
    with terrainwave.Terrain(paths[0]) as terrain:
        back = terrain.read()
    assert np.abs(back.astype(np.int64) - heights).max() <= max_error


def test_a_small_raster_pays_for_no_tables(tmp_path):
    terrainwave.compress(rough((60, 70)), tmp_path / "a.twz", max_error=1, method="predictive")
    assert header_of(tmp_path / "a.twz").file_tables == b""


@pytest.mark.large
def test_tables_of_rapid_are_the_same_on_any_number_of_threads(tmp_path):
    heights = rough((420, 390))
    files = [
        terrainwave.compress_to_bytes(heights, max_error=4, method="rapid", threads=threads)
        for threads in (1, 2)
    ]
    assert files[0] == files[1]
    (tmp_path / "a.twz").write_bytes(files[0])
    parameters = header_of(tmp_path / "a.twz").file_tables
    stencils = rapid_parameters.parse_file_tables(parameters).stencils
    assert (stencils != rapid_parameters.Tables(None).stencils).any()


def odd_rasters():
    """Return rasters that no one would train on."""
    rng = np.random.default_rng(5)
    rows, cols = np.mgrid[:300, :310]
    hills = 300 * np.sin(rows / 40) * np.cos(cols / 30)
    return {
        "hills": hills,
        "noise": rng.normal(0, 300, rows.shape),
        "loud noise": rng.normal(0, 3000, rows.shape),
        "spikes": hills + (rng.random(rows.shape) < 0.01) * rng.normal(0, 5000, rows.shape),
        "half noise": np.where(cols < 150, hills, rng.normal(0, 500, rows.shape)),
        "steps": np.floor(hills / 50) * 50,
        "checkers": 100 * ((rows + cols) % 2),
        "skew": np.exp(rng.normal(0, 2, rows.shape)),
    }


@pytest.mark.large
@pytest.mark.parametrize("max_error", [0, 1, 10])
@pytest.mark.parametrize("name", odd_rasters())
def test_what_format_1_1_adds_to_tables_of_rapid_makes_no_file_larger(name, max_error):
    heights = np.clip(np.rint(odd_rasters()[name]), -32000, 32000).astype(np.int16)
    new, old = (
        len(
            terrainwave.compress_to_bytes(
                heights, max_error=max_error, method="rapid", format=which
            )
        )
        for which in ("1.1", "1.0")
    )
    assert new <= 1.005 * old + 60
