"""Coded units without a file, for the tests of refiners: specs, heights, what each promises."""

import numpy as np

from terrainwave.codec.refiner import NOT_SHARED, GroupSpec, Sides
from terrainwave.codec.unit_specs import unit_spec
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Region

ALL_SHARED = Sides(True, True, True, True)
# Heights of a file span less than 2^30 quanta (FORMAT.md §4.1).
BIG = (1 << 29) - 1


def lone_spec(shape, step=3, effort=1, shared=NOT_SHARED, parent=True):
    """Return the spec of a unit of this shape that begins at its level's first sample."""
    core = Region(0, 0, *shape)
    above = Region(0, 0, (shape[0] + 1) // 2, (shape[1] + 1) // 2) if parent else None
    return GroupSpec.alone(core, step, -BIG, BIG, parent_region=above, shared=shared, effort=effort)


def check_refiner(refiner, spec, parent, target, mask=None):
    """Encode, decode, check everything promised; return the payload, the heights, the labels."""
    mask = np.ones(target.shape, dtype=bool) if mask is None else mask
    before = mask.copy()
    payload, heights, labels = refiner.encode(spec, parent, target, mask)
    np.testing.assert_array_equal(mask, before)
    back, back_labels = refiner.decode(spec, parent, mask, payload)
    assert back.dtype == np.int32
    np.testing.assert_array_equal(back, heights)
    error = np.abs(back.astype(np.int64) - target)[mask]
    assert error.max(initial=0) <= spec.half
    assert (labels is None) == (back_labels is None)
    if labels is not None:
        np.testing.assert_array_equal(labels, back_labels)
    return payload, heights, labels


def coarse_of(target, step):
    """Return parent heights within the bound of the target's even samples."""
    rng = np.random.default_rng(2)
    coarse = target[::2, ::2].astype(np.int64)
    half = step >> 1
    return np.clip(coarse + rng.integers(-half, half + 1, coarse.shape), -BIG, BIG).astype(np.int32)


def terrain(shape, seed=0, relief=400):
    """Return smooth random heights with some noise, the same for every machine."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    heights = np.zeros(shape)
    for wave in (3.0, 7.0, 19.0, 53.0):
        a, b, c = rng.uniform(0, 6.28, 3)
        heights += (
            relief * wave / 53 * np.sin(rows / wave + a) * np.cos(cols / wave * np.sin(c) + b)
        )
    return np.rint(heights + rng.normal(0, 1, shape)).astype(np.int32)


def hard_rasters(shape, largest):
    """Return heights by name that are hard to code, up to ±`largest`."""
    rng = np.random.default_rng(3)
    spike = np.zeros(shape, dtype=np.int32)
    spike[shape[0] // 2, shape[1] // 3] = largest
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return {
        "constant": np.full(shape, 1234, dtype=np.int32),
        "lowest": np.full(shape, -largest, dtype=np.int32),
        "spike": spike,
        "checkerboard": np.where((rows + cols) & 1, largest, -largest).astype(np.int32),
        "stripes": np.where(rows & 1, largest, -largest).astype(np.int32),
        "noise": rng.integers(-largest, largest, shape, dtype=np.int32),
        "mild noise": rng.integers(-9, 9, shape, dtype=np.int32),
        "ramp": (17 * rows - 5 * cols).astype(np.int32),
        "terrain": terrain(shape),
    }


def check_neighbours(refiner, grid, levels, rings, effort, masks, *, is_faithful=False):
    """Code all units of all levels in random order, with a step of 5; they must agree.

    `levels` and `masks` are the heights and the valid samples of each level, the coarsest first.
    """
    parameters = CodecParameters(5, -BIG, BIG, (1, 0), rings, effort, is_faithful=is_faithful)
    rng = np.random.default_rng(11)
    above = None
    for level, (target, mask) in enumerate(zip(levels, masks, strict=True)):
        whole = Region(0, 0, *target.shape)
        decoded = np.zeros(target.shape, dtype=np.int32)
        writers = np.zeros(target.shape, dtype=np.int64)
        keys = grid.root_keys() if level == 0 else grid.blocks(level - 1)
        for index in rng.permutation(len(keys)):
            spec = unit_spec(grid, parameters, keys[index])
            at = spec.region.slices_in(whole)
            parent = None
            if level > 0:
                parent = above[spec.parent_region.slices_in(Region(0, 0, *above.shape))]
            _, heights, _ = check_refiner(refiner, spec, parent, target[at], mask[at])
            seen = writers[at] > 0
            np.testing.assert_array_equal(decoded[at][seen], heights[seen])
            decoded[at] = heights
            writers[at] += 1
        assert (writers > 0).all()
        if len(keys) > 1:
            assert (writers > 1).any()
        above = decoded


def check_damaged(refiner, spec, parent, mask, payload):
    """Decode what may be damaged: heights within the format's range, or our own error."""
    try:
        heights, _ = refiner.decode(spec, parent, mask, payload)
    except CorruptStreamError:
        return
    assert heights.shape == spec.region.shape
    assert np.abs(heights.astype(np.int64)).max() <= BIG


def rough(shape, seed=0):
    """Return a surface of steps and slopes that no trained stencil was made for."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    waves = 90 * np.sin(rows / 1.7) * np.cos(cols / 1.9) + 300 * np.sin(rows / 40)
    return np.rint(waves + rng.normal(0, 2, shape)).astype(np.int32)
