"""Style of a picture."""

import math
from dataclasses import dataclass

from terrainwave.errors import InvalidArgumentError
from terrainwave.place.bodies import EARTH, MARS, MOON, OTHER, UNKNOWN
from terrainwave.render.look.colorings import AUTO, NO_SEA, RAMP_NAMES

# The shader's numbers.
_RAMP, _LEVEL, _ERROR, _GROUND, _PLAIN, _FLAT, _SLOPE, _TEXTURED = range(8)
COLORINGS = {
    "auto": _GROUND,
    "absolute": _GROUND,
    "relative": _GROUND,
    "ramp": _RAMP,
    "slope": _SLOPE,
    "textured": _TEXTURED,
    "plain": _PLAIN,
    "level": _LEVEL,
    "error": _ERROR,
    "flat": _FLAT,
}
_NAMES = {MOON: "the Moon", MARS: "Mars", OTHER: "another body"}
_RAMP_OF_BODY = {EARTH: "tints", UNKNOWN: "tints", MARS: "mars"}


def check_sea_level(value: str | float) -> None:
    """Raise `InvalidArgumentError` unless the value is a finite number or "auto" or "none"."""
    is_good = value in (AUTO, NO_SEA) if isinstance(value, str) else math.isfinite(value)
    if not is_good:
        raise InvalidArgumentError(
            f"found `sea_level` {value}, expected {AUTO}, {NO_SEA} or a height"
        )


@dataclass(frozen=True)
class Style:
    """Style of a picture.

    Parameters
    ----------
    coloring : str
        One of `colorings.MEANINGS`, which explains them.
    ramp : {"auto", "tints", "cividis", "grey", "mars"}
        For relative colours; by default that of the body. With ``auto`` as `coloring`, a ramp other
        than ``tints`` selects relative colours.
    sea_level : {"auto", "none"} or float
        For absolute colours: the height in the file's unit at and below which all is water, or
        none. With ``auto``, water is level ground at 0, and ground below 0 that is connected to
        heights below -450 m, under which there is no dry land (`water`).
    sun : tuple of float
        Azimuth and altitude in degrees.
    haze : float
        0 none … 1 much.
    shade : float
        Share of light and shadow, 0 … 1.
    drape : float
        Share of the orthophoto, if any, 0 … 1.
    wireframe : bool
    background : tuple of int, optional
        Red, green, blue instead of the sky and the ground; also the colour of haze.
    solid : bool
        Walls at the raster's sides, a floor, and a hatch over voids. Never with ``flat`` and
        `wireframe`, which show only the mesh.
    """

    coloring: str = "auto"
    ramp: str = AUTO
    sea_level: str | float = AUTO
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
        if self.ramp not in (AUTO, *RAMP_NAMES):
            raise InvalidArgumentError(
                f"found `ramp` {self.ramp!r}, expected one of {', '.join((AUTO, *RAMP_NAMES))}"
            )

        check_sea_level(self.sea_level)

    @property
    def has_legend(self) -> bool:
        """Return whether colours are values that a legend can explain."""
        return COLORINGS[self.coloring] in (_RAMP, _GROUND, _SLOPE, _ERROR, _TEXTURED)

    def is_absolute(self, body: str) -> bool:
        """Return whether heights on a body get the Earth's colours by metres."""
        if self.coloring == "absolute":
            return body in (EARTH, UNKNOWN)
        is_free = self.coloring in ("auto", "textured")
        return is_free and body == EARTH and self.ramp in (AUTO, "tints")

    def ramp_on(self, body: str) -> str:
        """Return the ramp of relative colours on a body."""
        return _RAMP_OF_BODY.get(body, "grey") if self.ramp == AUTO else self.ramp

    def check_body(self, body: str) -> None:
        """Raise `InvalidArgumentError` if the Earth's colours were requested for another body."""
        if self.coloring == "absolute" and not self.is_absolute(body):
            raise InvalidArgumentError(
                "found `coloring` absolute, whose water and snow are the Earth's, and a raster on"
                f" {_NAMES[body]}: expected `coloring` relative"
            )

    @property
    def draws_solid(self) -> bool:
        """Return whether walls, floor and lids are drawn."""
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
