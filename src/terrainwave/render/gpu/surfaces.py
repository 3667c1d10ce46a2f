"""Table of the surfaces that draw each mode's pieces."""

from typing import Any

from terrainwave.render.gpu.block_surface import BlockSurface
from terrainwave.render.gpu.front_surface import FrontSurface
from terrainwave.render.gpu.patch_surface import PatchSurface
from terrainwave.render.gpu.surface import Surface
from terrainwave.render.gpu.vertex_texture_surface import VertexTextureSurface

# By the names of `render.modes.MODES`: surfaces of equal blocks, and of meshes that are rebuilt
# each frame.
_OF_BLOCKS: dict[str, type[BlockSurface | PatchSurface]] = {
    "adaptive": PatchSurface,
    "batched": BlockSurface,
    "full": PatchSurface,
    "loose": PatchSurface,
}
_OF_FRONTS: dict[str, type[FrontSurface | VertexTextureSurface]] = {
    "dynamic": FrontSurface,
    "rqt": FrontSurface,
    "vertex-texture": VertexTextureSurface,
}


def surface_of(mode: str, context: Any, side: int, *, max_bytes: int) -> Surface:
    if mode in _OF_BLOCKS:
        return _OF_BLOCKS[mode](context, side, max_bytes=max_bytes)
    return _OF_FRONTS[mode](context, max_bytes=max_bytes)
