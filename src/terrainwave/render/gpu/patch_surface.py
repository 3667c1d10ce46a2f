"""Patches on the GPU, drawn by one indirect call if the driver supports it."""

from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render.gpu import shaders
from terrainwave.render.gpu.mesh_buffers import COMMAND, GpuStore
from terrainwave.render.gpu.surface import OWN_UNIT, release_all, set_uniforms
from terrainwave.render.scene.selection import View

if TYPE_CHECKING:
    from terrainwave.render.modes.mode import Frames
    from terrainwave.render.paging.scene import Scene

_INDIRECT_VERSION = 430
_SLOPES, _INSTANCES = OWN_UNIT, OWN_UNIT + 1


class PatchSurface:
    """`Surface` of patches.

    Parameters
    ----------
    context : moderngl.Context
        OpenGL 3.3 core or newer.
    side : int
        Cells of a block.

    Notes
    -----
    All patches are drawn by one call from OpenGL 4.3 on, else one by one.
    """

    n_clip_distances = 2

    def __init__(self, context: Any, side: int, *, max_bytes: int) -> None:
        self._context = context
        self._side = side
        self.store = GpuStore(context, side, max_bytes=max_bytes)
        self.is_indirect = context.version_code >= _INDIRECT_VERSION
        defines = "#define INDIRECT" if self.is_indirect else ""
        self.program = context.program(
            vertex_shader=shaders.TERRAIN_VERTEX.strip().replace("//DEFINES", defines),
            fragment_shader=shaders.TERRAIN_FRAGMENT.strip(),
        )
        self._instances: Any = None
        self._numbers: Any = None
        self._commands: Any = None
        self._array: Any = None
        self._generation = -1

    def _reach(self, n_patches: int) -> None:
        """Allocate the instances of `n_patches` and bind the buffers in use."""
        if self._instances is None or self._instances.size[1] < n_patches:
            release_all(self._instances, self._numbers, self._commands)
            n = max(256, 1 << (n_patches - 1).bit_length())
            self._instances = self._context.texture((4, n), 4, dtype="f4")
            self._instances.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self._numbers = self._context.buffer(np.arange(n, dtype=np.int32).tobytes())
            self._commands = self._context.buffer(reserve=n * COMMAND.itemsize)
            self._generation = -1
        if self._generation != self.store.generation:
            content: list[Any] = [(self.store.vertex_buffer, "2u2 2f4", "in_place", "in_heights")]
            if self.is_indirect:
                content.append((self._numbers, "1i4/i", "in_instance"))
            if self._array is not None:
                self._array.release()
            self._array = self._context.vertex_array(
                self.program, content, index_buffer=self.store.index_buffer, index_element_size=4
            )
            self._generation = self.store.generation

    def instances(self, scene: "Scene", view: View, frames: "Frames") -> NDArray[np.float32]:
        """Return the texels of the patches, float32 (n, 16): see `shaders`."""
        table, nodes = scene.table, frames.nodes
        grid, frame = scene.terrain.grid, scene.frame
        blocks = table.keys[nodes]
        strides = np.left_shift(1, grid.k_max - blocks[:, 0])
        rows, cols = blocks[:, 1] * grid.block * strides, blocks[:, 2] * grid.block * strides
        bases = table.bases[nodes]
        origins = np.column_stack([frame.samples_to_local(rows, cols), bases * view.exaggeration])
        texels = np.empty((len(nodes), 16), dtype=np.float32)
        texels[:, 0:3] = origins - view.camera.eye
        texels[:, 3] = frames.morphs
        texels[:, 4] = frames.skirts
        texels[:, 5] = self.store.layers_of(nodes)
        texels[:, 6] = -1
        texels[:, 7] = strides
        texels[:, 8] = grid.n_cols - 1 - cols
        texels[:, 9] = grid.n_rows - 1 - rows
        texels[:, 10] = (blocks[:, 2] & 1) * grid.block
        texels[:, 11] = (blocks[:, 1] & 1) * grid.block
        texels[:, 12] = blocks[:, 0]
        texels[:, 13] = table.errors[nodes]
        texels[:, 14:] = 0
        return texels

    def submit(self, scene: "Scene", view: View, frames: "Frames") -> int:
        """Draw patches; return the number of draw calls."""
        drawn = self.store.layers_of(frames.nodes) >= 0  # the others have no triangles
        n = int(drawn.sum())
        if not n:
            return 0
        frames = frames._replace(
            nodes=frames.nodes[drawn],
            distances=frames.distances[drawn],
            morphs=frames.morphs[drawn],
            skirts=frames.skirts[drawn],
        )
        self._reach(n)
        texels = self.instances(scene, view, frames)
        self._instances.write(texels.tobytes(), viewport=(0, 0, 4, n))
        set_uniforms(
            self.program,
            {"side": float(self._side), "slopes": _SLOPES, "instances": _INSTANCES},
        )
        self.store.slopes.use(_SLOPES)
        self._instances.use(_INSTANCES)
        commands = self.store.commands(frames.nodes)
        if self.is_indirect:
            self._commands.write(commands.tobytes())
            self._array.render_indirect(self._commands, moderngl.TRIANGLES, count=n)
            return 1
        for k, (count, _, first, _, _) in enumerate(commands.tolist()):
            self.program["in_instance"] = k
            self._array.render(moderngl.TRIANGLES, vertices=count, first=first)
        return n

    def release(self) -> None:
        release_all(
            self._instances, self._numbers, self._commands, self._array, self.program, self.store
        )  # fmt: skip
