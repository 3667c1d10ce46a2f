"""How a picture looks; no GPU."""

import math
from dataclasses import dataclass

from terrainwave.errors import (
    InvalidArgumentError,
)
from terrainwave.render.ramps import RAMPS

# The shader's numbers.
COLORINGS = {"ground": 3, "ramp": 0, "level": 1, "error": 2, "plain": 4, "flat": 5}


@dataclass(frozen=True)
class Style:
    """How the picture looks.

    Parameters
    ----------
    coloring : {"ramp", "ground", "level", "error", "plain", "flat"}
        By height; by height and slope; by level; by error; one colour; one colour without light.
    ramp : {"tints", "cividis", "grey", "mars"}
    sun : tuple of float
        Azimuth and altitude in degrees.
    haze : float
        0 none … 1 much.
    shade : float
        Share of light and shadow, 0 … 1.
    drape : float
        Share of the orthophoto where there is one, 0 … 1.
    wireframe : bool
    background : tuple of int, optional
        Red, green, blue instead of the sky and the ground; haze too has this colour.
    solid : bool
        Walls at the raster's sides, a floor, and a hatch over voids. Never with ``flat`` and with
        `wireframe`, which show the mesh alone.
    """

    coloring: str = "ground"
    ramp: str = "tints"
    sun: tuple[float, float] = (315.0, 38.0)
    haze: float = 0.25
    shade: float = 1.0
    drape: float = 1.0
    wireframe: bool = False
    background: tuple[int, int, int] | None = None
    solid: bool = True

    def __post_init__(self) -> None:
        if self.coloring not in COLORINGS:
            raise InvalidArgumentError(
                f"found `coloring` {self.coloring!r}, expected one of {', '.join(COLORINGS)}"
            )
        if self.ramp not in RAMPS:
            raise InvalidArgumentError(
                f"found `ramp` {self.ramp!r}, expected one of {', '.join(RAMPS)}"
            )

    @property
    def draws_solid(self) -> bool:
        """Say whether walls, floor and lids are drawn."""
        return self.solid and not self.wireframe and self.coloring != "flat"

    @property
    def sun_vector(self) -> tuple[float, float, float]:
        """Return the unit vector towards the sun."""
        azimuth, altitude = (math.radians(angle) for angle in self.sun)
        return (
            math.sin(azimuth) * math.cos(altitude),
            math.cos(azimuth) * math.cos(altitude),
            math.sin(altitude),
        )
