"""Build the `GroupSpec` of each coded unit of a file (FORMAT.md §2.4).

Units have the keys `Grid.root_keys` and the parents of groups.
"""

from terrainwave.codec.refiner import Decoded, GroupSpec, Sides
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Block, Grid, Region


def unit_core(grid: Grid, key: Block) -> Region:
    """Return the samples of the unit without its apron, on the level it codes."""
    if key.is_root_key:
        return grid.block_region(Block(0, key.row, key.col))
    return grid.group_region(key)


def unit_spec(grid: Grid, parameters: CodecParameters, key: Block) -> GroupSpec:
    apron = parameters.apron
    blocks_per_unit = 1 if key.is_root_key else 2
    level = key.level + 1
    if key.is_root_key:
        region = grid.block_region(Block(0, key.row, key.col), apron)
        parent_region = None
    else:
        region = grid.group_region(key, apron)
        parent_region = grid.block_region(key, apron)
    n_rows, n_cols = grid.level_blocks(level)
    shared = Sides(
        top=key.row > 0,
        left=key.col > 0,
        bottom=(key.row + 1) * blocks_per_unit < n_rows,
        right=(key.col + 1) * blocks_per_unit < n_cols,
    )
    is_finest = level == grid.k_max
    return GroupSpec(
        **vars(parameters) | ({} if is_finest else {"remainder_bytes": 0}),
        level=level,
        core=unit_core(grid, key),
        region=region,
        parent_region=parent_region,
        shared=shared,
        is_finest=is_finest,
        # Trees of a faithful file show where its meshes are fine; a root block refines none.
        wants_labels=parameters.is_faithful and not key.is_root_key,
        # As printed if the bound is a quantum or more; lossless is lossless on all levels.
        has_coarse_residuals=parameters.is_faithful and not is_finest and parameters.step > 1,
    )


def block_of_unit(grid: Grid, spec: GroupSpec, decoded: Decoded, block: Block) -> Decoded:
    """Return the part of a decoded unit that is `block`, with its apron, if any. A view."""
    return decoded.part(grid.block_region(block, spec.apron).slices_in(spec.region))
