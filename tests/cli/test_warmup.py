"""Does `terrainwave warmup` compile everything that later commands need?"""

import os
import subprocess
import sys

import numpy as np
import pytest
from strategies import terrain_like, write_geotiff

from terrainwave.names import METHODS
from terrainwave.render.modes import MODES

pytestmark = [pytest.mark.full, pytest.mark.large]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A raster with voids and one of floats without, of a shape that warmup does not use."""
    folder = tmp_path_factory.mktemp("warm")
    heights = terrain_like(301, 40, seed=3)[:, :250]
    heights[40:50, 7:30] = -32768
    write_geotiff(folder / "whole.tif", heights, nodata=-32768)
    write_geotiff(folder / "real.tif", heights.astype(np.float32) + np.float32(0.125))
    return folder


def run(folder, *words):
    """Run a command with the folder's cache of kernels; return how many it has compiled."""
    cache = folder / "kernels"
    before = len(list(cache.rglob("*.nbc")))
    done = subprocess.run(
        [sys.executable, "-m", "terrainwave", *words],
        cwd=folder,
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, (words, done.stdout, done.stderr)
    return len(list(cache.rglob("*.nbc"))) - before


def commands():
    for stem in ("whole", "real"):
        for method in METHODS:
            twz = f"{stem}-{method}.twz"
            yield "compress", f"{stem}.tif", twz, "--method", method, "--max-error", "1"
            yield "decompress", twz, f"{stem}-{method}.tif"
        twz = f"{stem}-auto.twz"
        yield "compress", f"{stem}.tif", twz, "--max-error", "1"
        yield "verify", twz, f"{stem}.tif", "--mesh"
        yield "mesh", twz, f"{stem}.obj", "--max-triangles", "3000"
        yield "mesh", twz, f"{stem}.glb", "--max-error", "4"
        yield "mesh", twz, f"{stem}.ply", "--level", "-2", "--optimise"
        yield "info", twz
    yield "compress", "whole.tif", "lossless.twz", "--max-error", "0"


@pytest.mark.gl
def test_after_warmup_nothing_is_compiled(folder):
    assert run(folder, "warmup") > 100
    compiled = {" ".join(words): run(folder, *words) for words in commands()}
    for mode in MODES:
        words = ("render", "whole-auto.twz", f"{mode}.png", "--mode", mode, "--size", "300x200")
        compiled[" ".join(words)] = run(folder, *words)
    assert {words: n for words, n in compiled.items() if n} == {}
    assert run(folder, "warmup", "--for", "compress,read") == 0
