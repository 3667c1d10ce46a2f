"""Does the native library leave nothing to numba where the default method encodes and reads?"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from commands import environment, python_with

import terrainwave
from terrainwave.coding import native_library

pytestmark = [pytest.mark.native, pytest.mark.large]
PROGRAM = """
import sys
sys.modules["numba"] = None  # importing it fails
import numpy as np, rasterio
import terrainwave
rng = np.random.default_rng(1)
heights = (np.cumsum(np.cumsum(rng.normal(size=(300, 400)), 0), 1) * 0.1).astype(sys.argv[2])
if sys.argv[2] == "float32":
    heights[50:90, 30:200] = np.nan
nodata = np.nan if sys.argv[2] == "float32" else None
path, made = sys.argv[1] + "/raster.tif", sys.argv[1] + "/made.twz"
profile = dict(driver="GTiff", height=300, width=400, count=1, dtype=sys.argv[2], nodata=nodata)
with rasterio.open(path, "w", **profile) as file:
    file.write(heights, 1)
for _ in range(2):
    terrainwave.compress(path, made, max_error=1.0, overwrite=True)
    with terrainwave.open(made) as terrain:
        terrain.read()
    assert terrainwave.verify(made, path).ok
"""


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_compress_read_and_verify_import_no_numba(dtype, library, tmp_path, monkeypatch):
    by_c = environment(**{native_library.SWITCH: "1"})
    python_with(["-W", "ignore", "-c", PROGRAM, tmp_path, dtype], env=by_c, check=True)
    # Numba's kernels decode what the library has encoded and proved.
    monkeypatch.setenv(native_library.SWITCH, "0")
    with terrainwave.open(tmp_path / "made.twz") as terrain:
        own = terrain.read()
    import rasterio

    with rasterio.open(tmp_path / "raster.tif") as file:
        heights = file.read(1)
    assert np.nanmax(np.abs(own.astype(np.float64) - heights)) <= 1
    np.testing.assert_array_equal(np.isnan(own), np.isnan(heights))


SLOW = """
import time
time.sleep(0.5)

def doubled(x):
    return 2 * x
"""


def test_a_thread_waits_for_a_module_that_another_imports(with_library, tmp_path, monkeypatch):
    (tmp_path / "slow_module.py").write_text(SLOW, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)

    @native_library.also_in_c("slow_module")
    def doubled(x):
        return x

    with ThreadPoolExecutor(2) as threads:
        assert list(threads.map(doubled, range(2))) == [0, 2]
