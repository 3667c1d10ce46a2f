"""Style of a picture."""

import math
import re
from dataclasses import dataclass
from typing import Any

from terrainwave.arguments import checked_whole, shown
from terrainwave.errors import InvalidArgumentError
from terrainwave.option_sets import FLAG, Kind, OptionSet, number, numbers, option, words
from terrainwave.place.bodies import EARTH, MARS, MOON, OTHER, UNKNOWN
from terrainwave.render.look.colorings import AUTO, COLORING_HELP, RAMP_NAMES, SEA_LEVEL

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


def _checked_color(name: str, color: Any) -> Any:
    expected = "red, green and blue, each 0 … 255 (on the command line six hexadecimal digits)"
    if not isinstance(color, tuple) or len(color) != 3:
        raise InvalidArgumentError(f"found `{name}` {shown(color)}, expected {expected}")
    return tuple(checked_whole(name, part, least=0, most=255, expected=expected) for part in color)


def _color(text: str) -> Any:
    is_color = re.fullmatch("#?[0-9a-fA-F]{6}", text)
    return tuple(bytes.fromhex(text.removeprefix("#"))) if is_color else text


@dataclass(frozen=True)
class Style(OptionSet):
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

    coloring: str = option(
        words(*COLORINGS), COLORING_HELP, default="auto", typed={"metavar": "NAME"}
    )
    ramp: str = option(
        words(AUTO, *RAMP_NAMES),
        "Relative colours. Default: those of the planet or moon. cividis suits colour-blind"
        " readers.",
        default=AUTO,
    )
    sea_level: str | float = option(
        SEA_LEVEL,
        "Height up to which absolute colours show water, in the file's unit, or none. auto: level"
        " ground at 0 is water, and ground below 0 that is connected to depths of more than 450 m.",
        default=AUTO,
    )
    sun: tuple[float, float] = option(
        numbers("azimuth, altitude"),
        "Direction of the light, in degrees.",
        default=(315.0, 38.0),
        typed={"default": "315,38"},
    )
    haze: float = option(
        number(least=0, most=1),
        "Haze in the distance; 0 is none.",
        default=0.25,
        typed={"has_range": True},
    )
    shade: float = option(number(least=0, most=1), default=1.0)
    drape: float = option(number(least=0, most=1), default=1.0)
    wireframe: bool = option(FLAG, "Draw edges only.", default=False)
    background: tuple[int, int, int] | None = option(
        Kind(_checked_color, _color, "RRGGBB"), "Colour to draw instead of the sky."
    )
    solid: bool = option(FLAG, default=True)

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
        return self.solid and not self.wireframe and self.coloring != "flat"

    @property
    def sun_vector(self) -> tuple[float, float, float]:
        azimuth, altitude = (math.radians(angle) for angle in self.sun)
        return (
            math.sin(azimuth) * math.cos(altitude),
            math.cos(azimuth) * math.cos(altitude),
            math.sin(altitude),
        )
