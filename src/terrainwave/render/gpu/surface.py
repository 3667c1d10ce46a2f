"""GPU half of a mode: the store of pieces and the program that draws them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render.gpu.shaders import TERRAIN_FRAGMENT
from terrainwave.render.modes.mode import Frames
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.selection import View

# Texture units; a mode's own begin at OWN_UNIT.
RAMP_UNIT, DRAPE_UNIT, OWN_UNIT = 0, 1, 2
WATER_UNIT, DETAIL_UNIT = 14, 15  # the last units in every driver
_SMALLEST = 256  # initial instances


class Surface(ABC):
    """A store and a program; made by `surfaces.surface_of`.

    The renderer sets the uniforms that `program` has, binds ramp and drape, sets depth test,
    wireframe and clip distances, and calls `submit`.
    """

    n_clip_distances: ClassVar[int]

    def __init__(self, context: Any, store: Any, vertex_shader: str) -> None:
        self._context, self.store = context, store
        self.program = program_of(context, vertex_shader, TERRAIN_FRAGMENT)

    @abstractmethod
    def submit(self, scene: Scene, view: View, frames: Frames) -> int:
        """Draw into the framebuffer in use; return the number of draw calls.

        Called with the nodes of `frames` in its store, the nearest first.
        """

    def release(self) -> None:
        """Free the GPU's memory of all that the surface holds."""
        held = [part for name, part in vars(self).items() if name != "_context"]
        release_all(*(part for part in held if hasattr(part, "release")))


class InstancedSurface(Surface):
    """Equal blocks of `side` cells, each an instance in a texture; `shaders.INSTANCE` reads it."""

    def __init__(self, context: Any, store: Any, vertex_shader: str, side: int) -> None:
        super().__init__(context, store, vertex_shader)
        self._side = side
        self._instances: Any = None

    def instances(self, scene: Scene, view: View, frames: Frames) -> NDArray[np.float32]:
        """Return the texels of the blocks that are not void, float32 (n, 16)."""
        table, nodes = scene.table, frames.nodes
        keys = table.keys[nodes]
        strides = np.left_shift(1, scene.mode.n_levels - 1 - keys[:, 0])
        rows, cols = keys[:, 1] * self._side * strides, keys[:, 2] * self._side * strides
        bases = table.bases[nodes]
        origins = np.column_stack(
            [scene.frame.samples_to_local(rows, cols), bases * view.exaggeration]
        )
        n_rows, n_cols = scene.frame.shape
        texels = np.zeros((len(nodes), 16), dtype=np.float32)
        texels[:, 0:3] = origins - view.camera.eye
        texels[:, 3], texels[:, 4] = frames.morphs, frames.skirts
        texels[:, 5] = self.store.layers_of(nodes)
        texels[:, 6], texels[:, 7] = keys[:, 0], strides
        texels[:, 8], texels[:, 9] = n_cols - 1 - cols, n_rows - 1 - rows
        texels[:, 10], texels[:, 11] = cols, rows
        texels[:, 12] = table.errors[nodes]
        return texels[texels[:, 5] >= 0]

    def submit(self, scene: Scene, view: View, frames: Frames) -> int:
        texels = self.instances(scene, view, frames)
        n = len(texels)
        if not n:
            return 0
        if self._instances is None or self._instances.size[1] < n:
            release_all(self._instances)
            size = 4, max(_SMALLEST, 1 << (n - 1).bit_length())
            self._instances = self._context.texture(size, 4, dtype="f4")
            self._instances.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self._instances.write(texels.tobytes(), viewport=(0, 0, 4, n))
        names = ("instances", "slopes", "heights")
        units = {name: OWN_UNIT + k for k, name in enumerate(names)}
        set_uniforms(self.program, {"side": float(self._side)} | units)
        textures = (self._instances, *self.store.layers.textures)
        for unit, texture in enumerate(textures, OWN_UNIT):
            texture.use(unit)
        return self.draw(frames.nodes, n)

    @abstractmethod
    def draw(self, nodes: NDArray[np.int32], n: int) -> int:
        """Draw the `n` instances of those `nodes` that are not void; return the draw calls."""


def program_of(context: Any, vertex_shader: str, fragment_shader: str) -> Any:
    return context.program(
        vertex_shader=vertex_shader.strip(), fragment_shader=fragment_shader.strip()
    )


def picture_of(context: Any, pixels: NDArray[np.uint8], filtering: int) -> Any:
    """Return a texture of uint8 (height, width, n_components), not repeated beyond its sides."""
    height, width, n_components = pixels.shape
    texture = context.texture((width, height), n_components, pixels.tobytes(), alignment=1)
    texture.repeat_x = texture.repeat_y = False
    texture.filter = (filtering, filtering)
    return texture


def set_uniforms(program: Any, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        # `in` would scan all names.
        if program.get(name, None) is not None:
            program[name] = value


def release_all(*parts: Any) -> None:
    """Free the GPU's memory of parts; None for parts that were never made."""
    for part in parts:
        if part is not None:
            part.release()
