"""Units of method rapid drawn by seed: each branch of its encoder, with heights of any kind."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrainwave.codec.refiner import (
    FREE,
    NO_CORRECTIONS,
    NOT_SHARED,
    Corrections,
    GroupSpec,
    Sides,
)
from terrainwave.grid.quadtree import Region

# Heights of a file lie within this, and span less (FORMAT.md §4.1).
MOST = 1 << 30
STEPS = (1, 1, 1, 3, 3, 5, 21, 2001, 8191, 8193, 100_001, MOST - 1)


class Drawn(NamedTuple):
    """A unit to be encoded, as `UnitCoder.encode` takes it, but for its corrections."""

    spec: GroupSpec
    parent: np.ndarray | None
    target: np.ndarray
    mask: np.ndarray | None
    kept: np.ndarray | None

    def corrections(self):
        """Return corrections that an encoder may fill."""
        if self.kept is None:
            return NO_CORRECTIONS
        return Corrections(self.kept, np.zeros_like(self.kept))


def side_of(rng, most):
    """Return rows or columns: often few, so that all that is special at borders is met."""
    return int(rng.integers(1, 4 if rng.random() < 0.15 else most))


def drawn_unit(rng, most=80):
    """Return a unit of at most so many rows and columns."""
    shape = side_of(rng, most), side_of(rng, most)
    step, amplitude = int(rng.choice(STEPS)), float(10 ** rng.uniform(0, 8.6))
    noise = rng.normal(size=shape)
    rough = 10 ** rng.uniform(-3, 0)
    smooth = np.cumsum(np.cumsum(noise, 0), 1) / noise.size if rng.random() < 0.5 else noise
    heights = amplitude * (smooth + rough * noise) + float(rng.choice([0, 0, 1e6, -3e8]))
    if rng.random() < 0.1:
        heights[:] = float(rng.choice([0, MOST // 2 - 1, -MOST // 2]))
    heights = np.clip(np.rint(heights), -MOST // 2, MOST // 2 - 1).astype(np.int32)
    margins = rng.integers(0, 3, 2) * 1000
    low = max(int(heights.min() - margins[0]), -MOST // 2)
    high = min(int(heights.max() + margins[1]), MOST // 2 - 1)
    mask = None
    if rng.random() < 0.5:
        mask = rng.random(shape) < rng.choice([0.0, 0.05, 0.5, 0.95, 0.999])
        if rng.random() < 0.3:  # whatever voids hold
            heights[~mask] = rng.integers(-(2**31), 2**31, np.count_nonzero(~mask))
    parent, shared, above = None, NOT_SHARED, None
    if rng.random() < 0.6:
        parent = _parent_of(rng, heights, step, low, high)
        shared = Sides(*(bool(side) for side in rng.random(4) < 0.5))
        above = Region(0, 0, *parent.shape)
    spec = GroupSpec.alone(
        Region(0, 0, *shape), step, low, high, parent_region=above, shared=shared
    )
    spec = replace(spec, level=int(rng.integers(0, 7)))
    kept = None
    if rng.random() < 0.3:
        near = heights + rng.integers(-3, 4, shape) * np.int64(step) // 2
        kept = np.where(rng.random(shape) < 0.5, FREE, np.clip(near, low, high)).astype(np.int32)
        heights = np.where(kept == FREE, heights, kept)
    return Drawn(spec, parent, heights, mask, kept)


def _parent_of(rng, heights, step, low, high):
    """Return heights near every second one of a unit, at times a part of a larger array."""
    coarse = heights[::2, ::2].astype(np.int64)
    coarse += rng.integers(-(step >> 1), (step >> 1) + 1, coarse.shape)
    coarse = np.clip(coarse, low, high).astype(np.int32)
    if rng.random() < 0.3:
        coarse = np.pad(coarse, ((1, 2), (2, 3)))[1:-2, 2:-3]
    return coarse
