"""Terrains that are hard to mesh: cliffs, plateaus, voids of any shape, mixed with flat sea."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from hypothesis import strategies as st
from rasterio.transform import Affine
from strategies import write_geotiff
from twz import grouped

import terrainwave
from terrainwave.grid.quadtree import Region
from terrainwave.verification.checks import deviation
from terrainwave.verification.on_grid import (
    QuantaScale,
    mesh_problems,
    must_be_covered,
    surface_of_mesh,
)

KINDS = (
    "smooth", "cliffs", "noise", "flat", "half sea", "spikes", "ramp", "steps", "rough patch",
    "graded",
)  # fmt: skip
VOIDS = ("none", "speckle", "disc", "stripes", "corners", "lines", "most", "border", "checkerboard")
TRANSFORMS = (
    (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
    (30.0, 0.0, 5e5, 0.0, -30.0, 4e6),
    (1 / 3600, 0.0, -118.5, 0.0, -1 / 3600, 34.2),
    (20.0, 7.0, 1e5, 5.0, -25.0, 2e6),
    (0.0, 10.0, 0.0, 10.0, 0.0, 0.0),
    (-5.0, 1.0, 10.0, 2.0, -3.0, 20.0),
)


@dataclass
class Case:
    """A raster and how to compress it; heights as stored."""

    heights: np.ndarray
    valid: np.ndarray
    options: dict[str, Any] = field(default_factory=dict)
    transform: tuple[float, ...] = TRANSFORMS[0]
    scale: float = 1.0
    offset: float = 0.0


def terrain(kind, shape, seed):
    """Return float64 heights of about -1 … 1."""
    rng = np.random.default_rng(seed)
    row, col = np.indices(shape)
    phase = rng.uniform(5, 60, 4)
    smooth = np.sin(row / phase[0] + phase[2]) * np.cos(col / phase[1] + phase[3])
    if kind == "smooth":
        return smooth
    if kind == "cliffs":
        return np.where(smooth + 0.3 * np.sin(row / 3.0) > 0.2, 0.9, -0.7) + 0.05 * smooth
    if kind == "noise":
        return rng.uniform(-1, 1, shape)
    if kind == "flat":
        return np.full(shape, 0.25)
    if kind == "half sea":
        slope = row * rng.uniform(-1, 1) + col * rng.uniform(-1, 1)
        land = slope - np.median(slope)
        hills = smooth + rng.normal(0, 0.1, shape) + 0.02 * np.abs(land)
        return np.where(land > 0, np.clip(np.abs(hills), 0, 1), 0)
    if kind == "spikes":
        return np.where(rng.random(shape) < 0.01, 1.0, 0.1 * smooth)
    if kind == "ramp":
        return (row * phase[0] - col * phase[1]) / (sum(shape) * 60)
    if kind == "steps":
        return np.floor(6 * smooth) / 6
    if kind == "ridges":
        # Askew: coarse samples miss their tops, or meet them, and meshes rise above both.
        folds = 0.4 * np.abs((row + 2 * col) % 23 - 11) / 11, np.abs((3 * row - col) % 37 - 18) / 18
        return folds[0] + 0.6 * folds[1]
    if kind == "roofs":
        # Ridges two samples wide of the level with a quarter of the samples, which has no error of
        # its own; between two such samples, a vertex that meets both slopes lies above them. All on
        # a slope: no vertex is higher than the highest sample.
        knots = np.arange(0, sum(shape) + 8, 4)
        folds = (np.interp(at, knots, knots // 8 % 2) for at in (row, col))
        return next(folds) + 0.25 * next(folds) + row / 20
    if kind == "graded":
        # Curved everywhere, so that long border lines have vertices, and rough in one corner.
        far = np.hypot(row / shape[0] - rng.choice([0, 1]), col / shape[1] - rng.choice([0, 1]))
        bowl = ((row - shape[0] / 2) / shape[0]) ** 2 + ((col - shape[1] / 3) / shape[1]) ** 2
        return bowl + 0.02 * rng.normal(0, 1, shape) * np.clip(far - rng.uniform(0, 1), 0, 1) ** 2
    patch = rng.normal(0, 0.4, shape)
    at = rng.integers(0, shape[0]), rng.integers(0, shape[1])
    near = np.hypot(row - at[0], col - at[1]) < rng.uniform(3, 40)
    return np.clip(np.where(near, patch, 0.02 * smooth), -1, 1)


def validity(kind, shape, seed):
    """Return a mask, True where valid; some sample always is."""
    rng = np.random.default_rng(seed + 1)
    row, col = np.indices(shape)
    valid = np.ones(shape, dtype=bool)
    if kind == "speckle":
        valid = rng.random(shape) > rng.choice([0.002, 0.02, 0.2])
    elif kind == "disc":
        for _ in range(rng.integers(1, 5)):
            at = rng.integers(0, shape[0]), rng.integers(0, shape[1])
            valid &= np.hypot(row - at[0], col - at[1]) > rng.uniform(0.5, 30)
    elif kind == "stripes":
        valid = (row * rng.integers(-2, 3) + col * rng.integers(-2, 3)) % 23 > 4
    elif kind == "corners":
        # On corners and borders of blocks of 32, and beside them.
        for place in (0, 31, 32, 33, 63, 64, 65, 96, 128):
            valid &= ~((row == place) & (col % 32 == rng.integers(0, 3)))
    elif kind == "lines":
        for _ in range(rng.integers(1, 4)):
            valid &= row != rng.choice([0, 32, 64, rng.integers(0, shape[0])])
            valid &= col != rng.choice([0, 32, 64, rng.integers(0, shape[1])])
    elif kind == "most":
        at = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        valid = np.hypot(row - at[0], col - at[1]) < rng.uniform(1, 50)
    elif kind == "border":
        width = int(rng.integers(1, 9))
        valid[:width] = valid[:, -width:] = False
    elif kind == "checkerboard":
        valid = (row // rng.integers(1, 5) + col // rng.integers(1, 5)) % 2 == 0
    if not valid.any():
        valid.flat[rng.integers(valid.size)] = True
    return valid


def make_case(
    kind, void, shape, seed, *, dtype="int16", amplitude=500.0, transform=0, scale=1.0, offset=0.0,
    **options,
):  # fmt: skip
    """Return a case; `amplitude` in units of the stored heights."""
    heights = terrain(kind, shape, seed) * amplitude
    if np.dtype(dtype).kind != "f":
        limits = np.iinfo(dtype)
        heights = np.clip(np.rint(heights), max(limits.min, -(1 << 29)) + 1, limits.max)
    heights = heights.astype(dtype)
    return Case(heights, validity(void, shape, seed), options, TRANSFORMS[transform], scale, offset)


@st.composite
def cases(draw, max_side=150):
    """Draw a case: any terrain, voids, type, size, place, block and method."""
    shape = draw(st.integers(2, max_side)), draw(st.integers(2, max_side))
    dtype, amplitude = draw(
        st.sampled_from(
            [
                ("int16", 300.0), ("int16", 30000.0), ("uint8", 120.0), ("uint16", 9000.0),
                ("int32", float(1 << 28)), ("float32", 800.0), ("float64", 5e4),
            ]
        )
    )  # fmt: skip
    scale = draw(st.sampled_from([1.0, 1.0, 0.1, -2.0]))
    share = draw(st.sampled_from([0.0, 0.0005, 0.005, 0.05]))
    bound = float(int(share * amplitude)) if dtype[0] != "f" else max(share, 1e-4) * amplitude
    bound *= abs(scale)
    mesh_error = draw(st.sampled_from([None, 0.0, bound, 4 * bound + 1]))
    return make_case(
        draw(st.sampled_from(KINDS)),
        draw(st.sampled_from(VOIDS)),
        shape,
        draw(st.integers(0, 2**16)),
        dtype=dtype,
        amplitude=amplitude,
        transform=draw(st.integers(0, len(TRANSFORMS) - 1)),
        scale=scale,
        offset=draw(st.sampled_from([0.0, 100.0])),
        max_error=bound,
        mesh_error=mesh_error,
        block=draw(st.sampled_from([32, 32, 64])),
        border_rings=draw(st.sampled_from([1, 3])),
        method=draw(st.sampled_from(["predictive", "cdf97", "store"])),
    )


def write_case(case, directory):
    """Write and compress a case; return the path of the .twz file."""
    heights, mask = case.heights, case.valid
    if heights.dtype.kind == "f":
        heights, mask = np.where(case.valid, heights, np.nan).astype(heights.dtype), None
    elif case.valid.all():
        mask = None
    raster = write_geotiff(
        directory / "case.tif",
        heights,
        mask=mask,
        transform=Affine(*case.transform),
        bands={"scales": case.scale, "offsets": case.offset},
    )
    terrainwave.compress(
        raster, directory / "case.twz", overwrite=True, verify=False, **grouped(case.options)
    )
    return directory / "case.twz"


def reader(case):
    """Return what `MeshVerification` reads originals with."""

    def read(region):
        part = region.slices_in(Region(0, 0, *case.heights.shape))
        return case.heights[part], case.valid[part]

    return read


def area_problems(terrain, case, mesh, region, level, max_error=None):
    """Return all that is wrong with a mesh of an area: surface, coverage, errors."""
    ruler = QuantaScale(terrain)
    found = list(mesh_problems(terrain, mesh, region, level))
    raw, valid = reader(case)(region)
    stated = ruler.in_sixteenths(mesh.error)
    measured = deviation(
        surface_of_mesh(terrain, mesh, region),
        ruler.sixteenths(raw, valid),
        valid,
        stated * (1 + 1e-9) + ruler.slack,
    )
    if measured.n_beyond:
        found.append(f"{measured} beyond {stated}")
    if max_error is not None and mesh.error > max_error * (1 + 1e-9):
        found.append(f"error {mesh.error} above {max_error}")
    if (must_be_covered(valid) & ~measured.is_covered).any():
        found.append("valid samples are not covered")
    return found
