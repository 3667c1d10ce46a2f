"""Code whole DEMs with `Cdf97` over the quadtree, check the promises, print sizes and speeds.

python benchmarks/cdf97_lab.py DEM.tif … --max-error 1 3 10 --peers
"""

import argparse
import dataclasses
import time

import numpy as np
import rasterio

from terrainwave.codec import units
from terrainwave.codec.cdf97 import Cdf97
from terrainwave.codec.refiner import GroupSpec, Sides
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.grid.quadtree import Block, Grid, Region


def pyramid(heights: np.ndarray, grid: Grid) -> list[np.ndarray]:
    """Return the heights of every level, coarsest first."""
    levels = [heights]
    for level in range(grid.k_max - 1, -1, -1):
        fine, shape = levels[-1], grid.level_shape(level)
        levels.append(lowpass_analysis(fine, (0, 0), fine.shape, (0, 0), shape))
    return levels[::-1]


def unit_spec(
    grid: Grid, parent: Block | None, block: Block | None, step: int, rings: int, effort: int
) -> GroupSpec:
    """Return the spec of the group below `parent`, or of the root block `block`."""
    big = 1 << 30
    parameters = units.CodecParameters(step, -big, big, (1, 0), rings, effort)
    key = Block(-1, block.row, block.col) if parent is None else parent
    return units.unit_spec(grid, parameters, key)


def code_pyramid(levels, masks, grid, step, rings, effort, check=True, only_level=None):
    """Code all units top down; return a dictionary of sizes and times."""
    refiner = Cdf97()
    stats = {"bytes": [0] * (grid.k_max + 1), "encode": 0.0, "decode": 0.0}
    decoded_above = None
    for level in range(grid.k_max + 1):
        target, mask = levels[level], masks[level]
        decoded = np.full(target.shape, np.iinfo(np.int32).min, dtype=np.int32)
        units = grid.blocks(0) if level == 0 else grid.blocks(level - 1)
        for block in units:
            parent_block = None if level == 0 else block
            spec = unit_spec(grid, parent_block, block, step, rings, effort)
            whole = Region(0, 0, *target.shape)
            at = spec.region.slices_in(whole)
            parent = None
            if spec.parent_region is not None:
                above = Region(0, 0, *decoded_above.shape)
                parent = np.ascontiguousarray(decoded_above[spec.parent_region.slices_in(above)])
            part, part_mask = np.ascontiguousarray(target[at]), np.ascontiguousarray(mask[at])
            begin = time.perf_counter()
            payload, heights, labels = refiner.encode(spec, parent, part, part_mask)
            stats["encode"] += time.perf_counter() - begin
            stats["bytes"][level] += len(payload)
            if check:
                begin = time.perf_counter()
                back, back_labels = refiner.decode(spec, parent, part_mask, payload)
                stats["decode"] += time.perf_counter() - begin
                assert (back == heights).all(), (spec, np.argwhere(back != heights)[:5])
                assert (labels is None) == (back_labels is None)
                assert labels is None or (labels == back_labels).all()
            error = np.abs(heights.astype(np.int64) - part)[part_mask]
            assert error.max(initial=0) <= spec.half, (spec, error.max())
            old = decoded[at]
            fresh = old == np.iinfo(np.int32).min
            seen = ~fresh
            assert (old[seen] == heights[seen]).all(), spec
            decoded[at] = heights
        decoded_above = decoded if only_level is None else levels[level]
    stats["decoded"] = decoded
    return stats


def load(path, crop):
    """Return heights as int32 and the mask of valid samples."""
    with rasterio.open(path) as source:
        heights = source.read(1)
        mask = source.read_masks(1) > 0
    if crop:
        heights, mask = heights[:crop, :crop], mask[:crop, :crop]
    if heights.dtype.kind == "f":
        assert (heights[mask] == np.rint(heights[mask])).all(), "only whole units"
    heights = np.where(mask, heights, np.median(heights[mask])).astype(np.int32)
    return heights, mask


def mask_pyramid(mask, grid):
    """Return the masks of all levels: valid iff any full-grid sample of the cells touching is."""
    masks = [mask]
    for level in range(grid.k_max - 1, -1, -1):
        fine = np.pad(masks[-1], 2)
        shape = grid.level_shape(level)
        out = np.zeros(shape, dtype=bool)
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                out |= fine[2 + dr :: 2, 2 + dc :: 2][: shape[0], : shape[1]]
        masks.append(out)
    return masks[::-1]


def peer_bytes(heights, max_error):
    """Return the sizes of SPERR and SZ3, the bound checked after rounding to integers."""
    import imagecodecs

    data, tol = heights.astype(np.float32), max_error + 0.4999

    def decode_sz3(payload):
        return imagecodecs.sz3_decode(payload, data.shape, data.dtype)

    sizes = {}
    for name, encode, decode in (
        (
            "sperr",
            lambda: imagecodecs.sperr_encode(data, level=tol, mode="pwe"),
            imagecodecs.sperr_decode,
        ),
        ("sz3", lambda: imagecodecs.sz3_encode(data, mode="abs", abs=tol), decode_sz3),
    ):
        payload = encode()
        back = np.asarray(decode(payload)).reshape(heights.shape)
        measured = np.abs(np.rint(back).astype(np.int64) - heights).max()
        sizes[name] = len(payload)
        if measured > max_error:
            print(f"   {name}: bound exceeded, {measured}")
    return sizes


def main() -> None:
    """Run the laboratory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dems", nargs="+")
    parser.add_argument("--max-error", type=int, nargs="+", default=[1, 3, 10])
    parser.add_argument("--block", type=int, default=256)
    parser.add_argument("--rings", type=int, default=1)
    parser.add_argument("--effort", type=int, default=1)
    parser.add_argument("--crop", type=int, default=0)
    parser.add_argument("--peers", action="store_true")
    parser.add_argument("--detail", action="store_true", help="border share, single-level cost")
    args = parser.parse_args()
    ratios = []
    for path in args.dems:
        heights, mask = load(path, args.crop)
        grid = Grid(*heights.shape, args.block)
        levels, masks = pyramid(heights, grid), mask_pyramid(mask, grid)
        for max_error in args.max_error:
            step, n = 2 * max_error + 1, heights.size
            stats = code_pyramid(levels, masks, grid, step, args.rings, args.effort)
            error = np.abs(stats["decoded"].astype(np.int64) - heights)[mask].max(initial=0)
            assert error <= max_error
            total = sum(stats["bytes"])
            line = (
                f"{path.split('/')[-1][:22]:22} {max_error:3} {8 * total / n:7.4f} bit/sample "
                f"(finest {8 * stats['bytes'][-1] / n:.4f}) max err {error} "
                f"enc {n / stats['encode'] / 1e6:5.2f} dec {n / stats['decode'] / 1e6:5.2f} MS/s"
            )
            if args.detail:
                alone = code_pyramid(levels, masks, grid, step, args.rings, args.effort, False, 1)
                line += f" finest from perfect parent {8 * alone['bytes'][-1] / n:.4f}"
                line += (
                    f" border {100 * border_bytes(levels, masks, grid, step, args) / total:.2f}%"
                )
            if args.peers:
                peers = peer_bytes(heights, max_error)
                ratios.append(total / min(peers.values()))
                line += "".join(f" {k} {8 * v / n:.4f}" for k, v in peers.items())
                line += f" ratio {ratios[-1]:.3f}"
            print(line, flush=True)
    if ratios:
        print(f"geometric mean ratio {np.exp(np.mean(np.log(ratios))):.4f}")


def border_bytes(levels, masks, grid, step, args):
    """Return how much larger the file is because sides are shared: coded again without."""
    original = globals()["unit_spec"]

    def without(*arguments):
        spec = original(*arguments)
        region = spec.core
        parent = spec.parent_region
        if parent is not None:
            parent = grid.block_region(Block(spec.level - 1, *_block_of(spec, grid)))
        return dataclasses.replace(
            spec,
            shared=Sides(False, False, False, False),
            region=region,
            parent_region=parent,
        )

    whole = sum(code_pyramid(levels, masks, grid, step, args.rings, args.effort, False)["bytes"])
    globals()["unit_spec"] = without
    try:
        alone = sum(_sizes_without_checks(levels, masks, grid, step, args))
    finally:
        globals()["unit_spec"] = original
    return whole - alone


def _block_of(spec, grid):
    side = 2 * grid.block
    return spec.core.row // side, spec.core.col // side


def _sizes_without_checks(levels, masks, grid, step, args):
    """Return bytes per level; shared samples are coded twice and needn't agree."""
    refiner = Cdf97()
    above = None
    for level, (target, mask) in enumerate(zip(levels, masks, strict=True)):
        decoded = np.zeros(target.shape, dtype=np.int32)
        total = 0
        for block in grid.blocks(max(level - 1, 0)):
            spec = unit_spec(grid, None if level == 0 else block, block, step, 1, args.effort)
            at = spec.core.slices_in(Region(0, 0, *target.shape))
            parent = None
            if above is not None:
                inside = spec.parent_region.slices_in(Region(0, 0, *above.shape))
                parent = np.ascontiguousarray(above[inside])
            payload, heights, _ = refiner.encode(
                spec, parent, np.ascontiguousarray(target[at]), np.ascontiguousarray(mask[at])
            )
            decoded[at] = heights
            total += len(payload)
        yield total
        above = decoded


if __name__ == "__main__":
    main()
