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


def test_tables_of_rapid_are_the_same_on_any_number_of_threads(tmp_path):
    heights = rough((420, 390))
    files = [
        terrainwave.compress_to_bytes(heights, max_error=4, method="rapid", threads=threads)
        for threads in (1, 2)
    ]
    assert files[0] == files[1]
    (tmp_path / "a.twz").write_bytes(files[0])
    parameters = header_of(tmp_path / "a.twz").file_tables
    fitted = rapid_parameters.parse_file_tables(parameters, 9)
    assert fitted.stencils != rapid_parameters.plain_tables(fitted.k_max, fitted.family).stencils
