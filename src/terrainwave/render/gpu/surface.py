"""The half of a mode on the GPU: where pieces are kept and the program that draws them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from terrainwave.render.scene.selection import View

if TYPE_CHECKING:
    from terrainwave.render.modes.mode import Frames
    from terrainwave.render.paging.scene import PieceStore, Scene

# Texture units; a mode's own begin at OWN_UNIT.
RAMP_UNIT, DRAPE_UNIT, OWN_UNIT = 0, 1, 2
WATER_UNIT, DETAIL_UNIT = 14, 15  # the last that every driver has


class Surface(Protocol):
    """A store and a program; made by `surfaces.surface_of`.

    The renderer sets those uniforms in `program` that `Renderer._set_uniforms` names and the
    program has, binds ramp and drape, sets depth test, wireframe and clip distances, and calls
    `submit`.
    """

    program: Any
    n_clip_distances: int

    @property
    def store(self) -> "PieceStore":
        """Return where pieces are kept."""

    def submit(self, scene: "Scene", view: View, frames: "Frames") -> int:
        """Draw into the framebuffer in use; return the number of draw calls.

        Called with the nodes of `frames` in its store, the nearest first.
        """

    def release(self) -> None:
        """Free the GPU's memory, the store's too."""


def set_uniforms(program: Any, values: Mapping[str, Any]) -> None:
    """Set those uniforms that the program has; compilers drop the ones it does not use."""
    for name, value in values.items():
        # `in` would look at one name after the other.
        if program.get(name, None) is not None:
            program[name] = value


def release_all(*parts: Any) -> None:
    """Free the GPU's memory of parts, None for those that were never made."""
    for part in parts:
        if part is not None:
            part.release()
