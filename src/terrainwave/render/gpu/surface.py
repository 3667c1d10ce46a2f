"""GPU half of a mode: the store of pieces and the program that draws them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from terrainwave.render.scene.selection import View

if TYPE_CHECKING:
    from terrainwave.render.modes.mode import Frames
    from terrainwave.render.paging.scene import PieceStore, Scene

# Texture units; a mode's own begin at OWN_UNIT.
RAMP_UNIT, DRAPE_UNIT, OWN_UNIT = 0, 1, 2
WATER_UNIT, DETAIL_UNIT = 14, 15  # the last units in every driver


class Surface(Protocol):
    """A store and a program; made by `surfaces.surface_of`.

    The renderer sets the uniforms of `Renderer._set_uniforms` that `program` has, binds ramp and
    drape, sets depth test, wireframe and clip distances, and calls `submit`.
    """

    program: Any
    n_clip_distances: int

    @property
    def store(self) -> "PieceStore":
        """Return the store of pieces."""

    def submit(self, scene: "Scene", view: View, frames: "Frames") -> int:
        """Draw into the framebuffer in use; return the number of draw calls.

        Called with the nodes of `frames` in its store, the nearest first.
        """

    def release(self) -> None:
        """Free the GPU's memory, including the store's."""


def set_uniforms(program: Any, values: Mapping[str, Any]) -> None:
    """Set the uniforms that the program has; compilers drop unused ones."""
    for name, value in values.items():
        # `in` would scan all names.
        if program.get(name, None) is not None:
            program[name] = value


def release_all(*parts: Any) -> None:
    """Free the GPU's memory of parts; None for parts that were never made."""
    for part in parts:
        if part is not None:
            part.release()
