"""The table of methods says what the modules of the methods do."""

import numpy as np
import pytest
from strategies import terrain_like

from terrainwave.codec.registry import refiner_by_name
from terrainwave.errors import UnsupportedVersionError
from terrainwave.file import TerrainFile
from terrainwave.names import METHODS
from terrainwave.write.compress import compress_to_bytes


def test_a_method_of_a_newer_version_is_not_supported():
    with pytest.raises(UnsupportedVersionError, match="uses method 'wave9'; this terrainwave has"):
        refiner_by_name("wave9")


@pytest.mark.parametrize("method", METHODS)
def test_a_file_of_each_method_keeps_its_bound(method):
    heights = terrain_like(40, 50)
    data = compress_to_bytes(heights, max_error=2, method=method, block=32)
    with TerrainFile(data) as file:
        assert file.info().method == method
        assert np.abs(file.read().astype(int) - heights).max() <= 2


# The kernels of `predictive` with one model for each decision are compiled for `fast` alone.
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(name, marks=pytest.mark.full if name == "predictive" else [])
        for name in METHODS
    ],
)
def test_efforts_of_a_method_give_other_bytes_where_its_line_says_so(method):
    heights = terrain_like(130, 130, seed=3)
    made = {
        compress_to_bytes(heights, max_error=1, method=method, block=64, effort=effort)
        for effort in ("fast", "best")
    }
    payloads = {data[128:] for data in made}
    assert (len(payloads) > 1) == bool(METHODS[method].effort)
