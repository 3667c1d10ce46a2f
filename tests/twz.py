"""Small .twz files in memory."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from terrainwave.codec.method_options import chosen
from terrainwave.grid.quadtree import Region
from terrainwave.terrain import Terrain
from terrainwave.tri.mesh_options import options_of
from terrainwave.write.compress import compress

# Of methods, with their defaults: tests that draw options from tables name them side by side.
OF_METHODS = {"border_rings": 1, "faithful": False, "rate": None, "psnr": None}


def grouped(options):
    """Return options side by side as `compress` takes them, in those of methods and meshes."""
    options = dict(options)
    given = {name: options.pop(name) for name in OF_METHODS if name in options}
    given = {name: value for name, value in given.items() if value != OF_METHODS[name]}
    if given:
        choice = chosen(options.get("method", "auto"), options.get("effort", "default"))
        options["method"], options["effort"] = replace(choice.own, **given), choice.effort
    if "mesh" in options:
        options["mesh"] = mesh_of(options["mesh"])
    return options


def mesh_of(mesh):
    """Return the options that the name of a stored kind of meshes stands for, or what is given."""
    name, _, value = str(mesh).partition("-")
    if not value:
        return mesh
    kind = options_of(name)
    (option,) = kind.names()
    return kind(**{option: value})


def twz_bytes(heights, **options):
    """Return the bytes of the file that `compress` makes of an array or a path; no digests."""
    with tempfile.TemporaryDirectory() as directory:
        target = Path(directory) / "small.twz"
        of_tests = {"block": 32, "threads": 1, "digest": False}
        compress(heights, target, **of_tests | grouped(options))
        return target.read_bytes()


def stated_bounds_problems(path, heights, nodata):
    """Return the finest blocks whose stated error or box does not hold for the heights."""
    found = []
    with Terrain(path) as terrain:
        decoded = terrain.read().astype(int)
        for block in terrain.grid.blocks(terrain.grid.k_max):
            region = terrain.grid.block_region(block)
            at = region.slices_in(Region(0, 0, *heights.shape))
            valid = heights[at] != nodata
            if not valid.any():
                continue
            error = np.abs(decoded[at] - heights[at])[valid].max()
            low, high = terrain.block_box(block)
            # Originals and what their error leaves room for, inside the file's range.
            stated, info = terrain.block_error(block), terrain.info()
            least = max(heights[at][valid].min() - stated, info.minimum)
            most = min(heights[at][valid].max() + stated, info.maximum)
            if error > stated or least < low or most > high:
                found.append((block, error))
    return found
