"""Where `Style` was before 1.1; `terrainwave.render.look.style` has it."""

import warnings
from typing import Any


def __getattr__(name: str) -> Any:
    if name != "Style":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from terrainwave.render.look.style import Style

    warnings.warn(
        "found terrainwave.render.style.Style, which goes in 2.0: import Style from"
        " terrainwave.render.look.style",
        DeprecationWarning,
        stacklevel=2,
    )
    return Style
