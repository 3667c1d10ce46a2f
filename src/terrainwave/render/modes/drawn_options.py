"""Options of a terrain on the screen, which pictures and windows, Python and commands share."""

from dataclasses import dataclass
from typing import Any

from terrainwave.arguments import RADIUS_HELP
from terrainwave.option_sets import FLAG, OptionSet, number, option, whole, words
from terrainwave.render.modes import MODES, options_of

_OF_MODES = ("orientation", "tree", "stepwise", "order", "detail")


@dataclass(frozen=True, kw_only=True)
class DrawnOptions(OptionSet):
    """Options of a terrain on the screen; `Terrain.view` describes them."""

    mode: str = option(
        words(*MODES),
        "How to draw the terrain: docs/viewing.md describes the modes.",
        default="adaptive",
    )
    orientation: bool = option(
        FLAG,
        "With --mode adaptive, batched or loose: draw fewer triangles where the camera looks down,"
        " because errors are vertical. Shading becomes coarser there, too.",
        default=False,
    )
    tree: int | None = option(
        whole(*(1 << k for k in range(1, 9)), expected="a power of two, 2 … 256"),
        "With --mode dynamic or vertex-texture: samples on each side of a quadtree, a power of two"
        " from 2 to 256. Default: 16.",
        typed={"metavar": "SAMPLES"},
    )
    stepwise: bool = option(
        FLAG,
        "With --mode dynamic or vertex-texture: change one height of the quadtree in each frame.",
        default=False,
    )
    order: int | None = option(
        whole(2, 4),
        "With --mode batched: order of the filter of levels. Default: 4.",
        typed={"metavar": "[2|4]"},
    )
    detail: float | None = option(
        number(above=0),
        "With --mode batched --error paper: the error of a level is this factor times its spacing."
        " Default: 0.5.",
        typed={"metavar": "FACTOR", "has_range": True},
    )
    error: str = option(
        words("measured", "paper", "coefficient"),
        "Errors and formula that select blocks. coefficient: wavelet coefficients, for mode rqt and"
        " files of method cdf53.",
        default="measured",
    )
    exaggeration: float = option(
        number(above=0),
        "Multiply heights by this factor.",
        default=1.0,
        typed={"has_range": True},
    )
    radius: float | None = option(number(above=0), RADIUS_HELP, typed={"metavar": "METRES"})

    def of_mode(self) -> dict[str, Any]:
        """Return the given options of the mode; raise `InvalidArgumentError` for another's."""
        return options_of(self.mode, **{name: getattr(self, name) for name in _OF_MODES})
