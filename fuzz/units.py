"""Coded units to decode hostile payloads in: specs, true parents and false ones."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from terrainwave.codec.group import encode_unit
from terrainwave.codec.masks import Above, decode_validity
from terrainwave.codec.refiner import (
    FREE,
    NOT_SHARED,
    Decoded,
    GroupSpec,
    Refiner,
    Sides,
    Validity,
    as_array,
)
from terrainwave.codec.unit_specs import unit_spec
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid, Region

_BIG = 1 << 30
_SHARED = Sides(True, True, True, True)


def _group(shape, sides, step, **options):
    """Return the spec of a unit that begins at its level's first sample."""
    core = Region(0, 0, *shape)
    above = Region(0, 0, (shape[0] + 1) // 2, (shape[1] + 1) // 2)
    limits = {"z_min": -_BIG, "z_max": _BIG} | options
    return GroupSpec.alone(core, step, parent_region=above, shared=sides, effort=1, **limits)


def _in_grid(key, step, rings):
    parameters = CodecParameters(step, -5000, 5000, (7, 7), rings, 1)
    return unit_spec(Grid(70, 69, 32), parameters, key)


_GROUP = _group((9, 11), NOT_SHARED, 3, z_min=-50, z_max=50, forbidden=(2, 2))
SPECS: tuple[GroupSpec, ...] = (
    _GROUP,
    replace(_GROUP, parent_region=None),
    _group((9, 11), _SHARED, 1),
    _group((1, 6), NOT_SHARED, 5),
    _group((17, 13), _SHARED, (1 << 30) + 1),
    replace(_group((9, 9), NOT_SHARED, 1), remainder_bytes=8),
    replace(_group((9, 9), _SHARED, 3), is_faithful=True, has_coarse_residuals=True),
    _in_grid(Block(1, 0, 0), 1, 3),
    _in_grid(Block(-1, 0, 0), 3, 1),
    _in_grid(Block(1, 1, 1), 1, 3),
)
# Few samples stand for many where kernels run as plain Python: the same code, a hundredth of the
# time.
SMALL_SISTERS = {4: 2, 7: 9, 8: 1}
N_PARENTS = 5


class Heights(NamedTuple):
    """Heights and validity, int32 and bool of one shape."""

    heights: np.ndarray
    mask: np.ndarray


@cache
def target_of(number: int) -> Heights:
    """Return what a true payload of spec `number` holds."""
    spec = SPECS[number]
    rows, cols = np.mgrid[: spec.region.n_rows, : spec.region.n_cols]
    noise = np.random.default_rng(number).integers(-2, 3, rows.shape)
    heights = (30 * np.sin(rows / 5) * np.cos(cols / 7) + noise).astype(np.int32)
    heights[heights == 2] = 3
    mask = np.ones(heights.shape, dtype=np.bool_)
    if number % 2 == 0:
        mask[3:6, 2:4] = False
    return Heights(heights, mask)


@cache
def parent_of(number: int, kind: int) -> Decoded | None:
    """Return a parent for spec `number`: 0 the true one, else ones that no file would have.

    They are: constant, at the limits in turn, random, with voids at random.
    """
    spec = SPECS[number]
    if spec.parent_region is None:
        return None
    shape = spec.parent_region.shape
    rng = np.random.default_rng(kind)
    mask = np.ones(shape, dtype=np.bool_)
    if kind == 0:
        heights = target_of(number).heights[::2, ::2][: shape[0], : shape[1]]
        heights = np.pad(heights, [(0, n - k) for n, k in zip(shape, heights.shape)], mode="edge")
    elif kind == 1:
        heights = np.full(shape, spec.z_max, dtype=np.int32)
    elif kind == 2:
        checks = np.indices(shape).sum(axis=0) % 2 == 0
        heights = np.where(checks, spec.z_min, spec.z_max).astype(np.int32)
    else:
        heights = rng.integers(spec.z_min, spec.z_max, shape, np.int32, endpoint=True)
        if kind == 4:
            mask = rng.random(shape) < 0.8
    heights = np.ascontiguousarray(heights, dtype=np.int32)
    heights.flags.writeable = mask.flags.writeable = False
    return Decoded(heights, Validity.of(mask))


def _below(mask: np.ndarray, spec: GroupSpec, parent: Decoded | None) -> np.ndarray:
    """Return a mask as a unit below a parent may have it: as without a section where that is so."""
    if parent is None or spec.parent_region is None:
        return mask
    above = Above(spec.parent_region, parent.validity)
    known = as_array(decode_validity(b"", spec.region, above, is_finest=True).mask, mask.shape)
    row, col = spec.region.row & 1, spec.region.col & 1
    mask = mask & known
    mask[row::2, col::2] = known[row::2, col::2]
    return mask


def payload_of(refiner: Refiner, number: int, kind: int) -> bytes:
    """Return a payload that is right for a spec and a parent."""
    spec, parent = SPECS[number], parent_of(number, kind)
    target, mask = target_of(number)
    mask = _below(mask, spec, parent)
    return encode_unit(refiner, spec, parent, target.copy(), mask)[0]


def corrected(spec: GroupSpec) -> GroupSpec:
    """Return a spec of a file with corrections, if its step has any."""
    return replace(spec, has_corrections=True) if spec.step > 1 else spec


def corrected_payload_of(refiner: Refiner, number: int, kind: int) -> bytes:
    """Return the same with corrections: some heights must come back a little off their targets."""
    spec, parent = corrected(SPECS[number]), parent_of(number, kind)
    target, mask = target_of(number)
    mask = _below(mask, spec, parent)
    rng = np.random.default_rng(number)
    apart = rng.integers(-spec.half, spec.half, target.shape, np.int32, endpoint=True)
    near = np.clip(target.astype(np.int64) + apart, spec.z_min, spec.z_max).astype(np.int32)
    kept = np.where(rng.random(target.shape) < 0.3, near, FREE)
    return encode_unit(refiner, spec, parent, target.copy(), mask, kept=kept)[0]
