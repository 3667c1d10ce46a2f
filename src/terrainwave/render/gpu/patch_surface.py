"""Patches on the GPU, drawn by one indirect call from OpenGL 4.3 on, else one by one."""

from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render.gpu.mesh_buffers import COMMAND, GpuStore
from terrainwave.render.gpu.shaders import TERRAIN_VERTEX
from terrainwave.render.gpu.surface import InstancedSurface, release_all

_INDIRECT_VERSION = 430


class PatchSurface(InstancedSurface):
    """`Surface` of patches."""

    n_clip_distances = 2

    def __init__(self, context: Any, side: int, *, max_bytes: int) -> None:
        self.is_indirect = context.version_code >= _INDIRECT_VERSION
        defines = "#define INDIRECT" if self.is_indirect else ""
        shader = TERRAIN_VERTEX.replace("//DEFINES", defines)
        super().__init__(context, GpuStore(context, side, max_bytes=max_bytes), shader, side)
        self._numbers: Any = None
        self._commands: Any = None
        self._array: Any = None
        self._bound = (0, 0)  # instances and generation of the store

    def draw(self, nodes: NDArray[np.int32], n: int) -> int:
        n_most = self._instances.size[1]
        if self._bound != (n_most, self.store.generation):
            self._bind(n_most)
        commands = self.store.commands(nodes[self.store.layers_of(nodes) >= 0])
        if self.is_indirect:
            self._commands.write(commands.tobytes())
            self._array.render_indirect(self._commands, moderngl.TRIANGLES, count=n)
            return 1
        for k, (count, _, first, _, _) in enumerate(commands.tolist()):
            self.program["in_instance"] = k
            self._array.render(moderngl.TRIANGLES, vertices=count, first=first)
        return n

    def _bind(self, n_most: int) -> None:
        release_all(self._array, self._numbers, self._commands)
        self._numbers = self._context.buffer(np.arange(n_most, dtype=np.int32).tobytes())
        self._commands = self._context.buffer(reserve=n_most * COMMAND.itemsize)
        content: list[Any] = [(self.store.vertex_buffer, "2u2 2f4", "in_place", "in_heights")]
        if self.is_indirect:
            content.append((self._numbers, "1i4/i", "in_instance"))
        self._array = self._context.vertex_array(
            self.program, content, index_buffer=self.store.index_buffer, index_element_size=4
        )
        self._bound = n_most, self.store.generation
