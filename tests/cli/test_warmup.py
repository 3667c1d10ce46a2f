"""Does `terrainwave warmup` compile everything that later commands need?

Kernels may come from the tests' cache: a process knows the types of those that it has loaded, too.
That kernels of one process are found by another is told by test_containers.py.
"""

import json
import shutil
import tempfile

import numpy as np
import pytest
from affine import Affine
from commands import python
from strategies import terrain_like, write_geotiff

from terrainwave.names import METHODS
from terrainwave.render.modes import MODES

pytestmark = [pytest.mark.full, pytest.mark.large]

PROGRAM = """
import gc, json, sys
from numba.core import event
from numba.core.dispatcher import Dispatcher
from terrainwave.cli import main
with event.install_recorder("numba:compile") as recorder:
    for words in json.loads(sys.argv[1]):
        main(words, standalone_mode=False)
kernels = [one for one in gc.get_objects() if issubclass(type(one), Dispatcher)]
found = [
    f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}{signature}"
    for kernel in kernels if kernel.py_func.__module__.startswith("terrainwave.")
    for signature in kernel.signatures
]
json.dump([len(recorder.buffer), found], sys.stderr)
"""


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


def needed(folder, *commands):
    """Run commands in a process; return how many kernels it compiled, and all that it has."""
    with tempfile.TemporaryDirectory() as place:
        for raster in folder.iterdir():
            shutil.copy(raster, place)
        done = python(PROGRAM, json.dumps(commands), cwd=place, timeout=None)
    assert done.returncode == 0, (done.stdout, done.stderr)
    n_compiled, found = json.loads(done.stderr.splitlines()[-1])
    return n_compiled, set(found)


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
def test_warmup_has_all_kernels_that_commands_need(folder):
    pictures = [
        ["render", "whole-auto.twz", f"{mode}.png", "--mode", mode, "--size", "300x200"]
        for mode in MODES
    ]
    n_compiled, kept = needed(folder, ["warmup"])
    if n_compiled:  # what a kernel that is compiled calls is listed, too
        _, kept = needed(folder, ["warmup"])
    n_compiled, found = needed(folder, *map(list, commands()), *pictures)
    assert len(found) > 100
    assert (n_compiled, sorted(found - kept)) == (0, [])
