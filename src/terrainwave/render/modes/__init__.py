"""Modes of the viewer: which pieces there are, how they are built, chosen and drawn.

Importing this package imports no mode: `mode_class` does.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from terrainwave.errors import (
    InvalidArgumentError,
)

if TYPE_CHECKING:
    from terrainwave.render.modes.mode import Mode

# name: module and class below this package
_CLASSES = {
    "adaptive": ("adaptive", "Adaptive"),
    "batched": ("batched", "Batched"),
    "dynamic": ("dynamic", "Dynamic"),
    "full": ("full", "Full"),
    "loose": ("loose", "Loose"),
    "rqt": ("rqt", "Rqt"),
    "vertex-texture": ("vertex_texture", "VertexTexture"),
}
MODES = tuple(_CLASSES)


def mode_class(name: str) -> "type[Mode]":
    """Return the class of a mode.

    Raises
    ------
    InvalidHeightsError
        If there is none of this name.
    """
    if name not in _CLASSES:
        raise InvalidArgumentError(f"found `mode` {name!r}, expected one of {', '.join(MODES)}")
    module, attribute = _CLASSES[name]
    mode: type[Mode] = getattr(import_module(f"{__name__}.{module}"), attribute)
    return mode
