"""Does `terrainwave warmup` compile everything that later commands need?"""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from affine import Affine
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
    new = heights[60:180, 9:30] // 2 + heights.max() // 2
    write_geotiff(folder / "new.tif", new, transform=Affine.translation(9, 60))
    write_geotiff(folder / "real.tif", heights.astype(np.float32) + np.float32(0.125))
    return folder


def run(folder, *commands):
    """Run commands in a process with the folder's cache; return what each has compiled."""
    cache = folder / "kernels"
    program = """
import json, pathlib, sys
from terrainwave.cli import main
cache, compiled = pathlib.Path(sys.argv[1]), {}
for words in json.loads(sys.argv[2]):
    before = {path.name for path in cache.rglob("*.nbc")}
    main(words, standalone_mode=False)
    new = {path.name for path in cache.rglob("*.nbc")} - before
    if new:
        compiled[" ".join(words)] = sorted(name.split("-")[0] for name in new)
json.dump(compiled, sys.stderr)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(cache), json.dumps(commands)],
        cwd=folder,
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, (done.stdout, done.stderr)
    return json.loads(done.stderr.splitlines()[-1])


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
    for method in ("rapid", "predictive"):
        yield "patch", f"whole-{method}.twz", "new.tif"
        yield "decompress", f"whole-{method}.twz", f"patched-{method}.tif"


@pytest.mark.gl
def test_after_warmup_nothing_is_compiled(folder):
    assert len(run(folder, ["warmup"])["warmup"]) > 100
    pictures = [
        ["render", "whole-auto.twz", f"{mode}.png", "--mode", mode, "--size", "300x200"]
        for mode in MODES
    ]
    warmed = ["warmup", "--for", "compress,read"]
    assert run(folder, *map(list, commands()), *pictures, warmed) == {}
