"""Square array textures whose layers are allocated and freed together."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from terrainwave.render.gpu.arena import Arena

_MAX_LAYERS = 2048
_LEAST_LAYERS = 8
_FIRST_BYTES = 64 << 20  # growing copies through main memory, so it should be rare


class TexelType(NamedTuple):
    """Content of a texture: numbers per texel, moderngl's type, bytes per texel."""

    n_components: int
    dtype: str
    n_bytes: int
    is_smooth: bool


# Slopes to the east and north, height; drivers pad three numbers to four.
SLOPES = TexelType(3, "f2", 8, True)
HEIGHTS = TexelType(2, "f4", 8, False)


class LayeredTextures:
    """Array textures of `size` x `size` texels, one of each kind, with equal numbers of layers.

    They grow by doubling, up to `max_bytes` together; a few layers are kept in any case.
    """

    def __init__(
        self, context: Any, size: int, kinds: Sequence[TexelType], *, max_bytes: int
    ) -> None:
        self._context, self._size, self._kinds = context, size, kinds
        self._layer_bytes = size * size * sum(kind.n_bytes for kind in kinds)
        allowed = int(context.info.get("GL_MAX_ARRAY_TEXTURE_LAYERS", 256))
        n_layers = min(max_bytes // self._layer_bytes, allowed, _MAX_LAYERS)
        self.max_layers = max(n_layers, _LEAST_LAYERS)
        first = max(_FIRST_BYTES // self._layer_bytes, _LEAST_LAYERS)
        self._free = Arena(min(first, self.max_layers))
        self.textures = [self._new(kind, self._free.capacity) for kind in kinds]

    def _new(self, kind: TexelType, n_layers: int) -> Any:
        shape = self._size, self._size, n_layers
        texture = self._context.texture_array(
            shape, kind.n_components, dtype=kind.dtype, alignment=4
        )
        filtering = moderngl.LINEAR if kind.is_smooth else moderngl.NEAREST
        texture.filter = (filtering, filtering)
        texture.repeat_x = texture.repeat_y = False
        return texture

    @property
    def max_bytes(self) -> int:
        return self.max_layers * self._layer_bytes

    @property
    def n_bytes(self) -> int:
        return self._free.capacity * self._layer_bytes

    def take(self) -> int | None:
        layer = self._free.take(1)
        if layer is None and self._free.capacity < self.max_layers:
            self._grow(min(2 * self._free.capacity, self.max_layers))
            layer = self._free.take(1)
        return layer

    def give_back(self, layer: int) -> None:
        self._free.give_back(layer, 1)

    def write(self, layer: int, contents: Sequence[NDArray[Any]]) -> None:
        """Fill a layer of each texture from its first corner; arrays (n_rows, n_cols, n)."""
        for texture, content in zip(self.textures, contents, strict=True):
            n_rows, n_cols = content.shape[:2]
            data = np.ascontiguousarray(content)
            texture.write(data, viewport=(0, 0, layer, n_cols, n_rows, 1))

    def _grow(self, n_layers: int) -> None:
        n_old = self._free.capacity
        for number, (old, kind) in enumerate(zip(self.textures, self._kinds, strict=True)):
            new = self._new(kind, n_layers)
            new.write(old.read(), viewport=(0, 0, 0, self._size, self._size, n_old))
            old.release()
            self.textures[number] = new
        self._free.grow(n_layers)

    def release(self) -> None:
        for texture in self.textures:
            texture.release()
