"""Modes of the viewer: definition, construction, selection and drawing of pieces.

Importing this package imports no mode: `mode_class` does.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from terrainwave.arguments import one_of
from terrainwave.errors import InvalidArgumentError

if TYPE_CHECKING:
    from terrainwave.render.modes.mode import Mode

# name: module and class below this package
_CLASSES = {
    "adaptive": ("adaptive", "Adaptive"),
    "batched": ("batched", "Batched"),
    "dynamic": ("dynamic", "Dynamic"),
    "full": ("full", "Full"),
    "loose": ("loose", "Loose"),
    "rqt": ("rqt", "RqtMode"),
    "vertex-texture": ("vertex_texture", "VertexTexture"),
}
MODES = tuple(_CLASSES)


def options_of(name: str, **options: Any) -> dict[str, Any]:
    """Return the given options of a mode: neither None nor False."""
    given = {option: value for option, value in options.items() if value not in (None, False)}
    for option in given:
        if option not in mode_class(name).options:
            fit = [mode for mode in MODES if option in mode_class(mode).options]
            raise InvalidArgumentError(
                f"found `{option}` in mode {name}, expected mode {one_of(fit)}"
            )
    return given


def mode_class(name: str) -> "type[Mode]":
    if name not in _CLASSES:
        raise InvalidArgumentError(f"found `mode` {name!r}, expected one of {', '.join(MODES)}")
    module, attribute = _CLASSES[name]
    mode: type[Mode] = getattr(import_module(f"{__name__}.{module}"), attribute)
    return mode
