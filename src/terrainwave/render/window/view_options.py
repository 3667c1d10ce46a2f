"""`ViewOptions`: the options of `Terrain.view`, and of the commands render and view."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from terrainwave.arguments import check_choice, checked_numbers, shown
from terrainwave.errors import InvalidArgumentError
from terrainwave.option_sets import BOUNDS, PATH, Kind, number, number_in, option
from terrainwave.render.look.style import Style
from terrainwave.render.modes import mode_class
from terrainwave.render.modes.drawn_options import DrawnOptions


def _checked_size(name: str, size: Any) -> Any:
    with suppress(InvalidArgumentError):
        sides = checked_numbers(name, size, "width, height", is_whole=True)
        if min(sides) >= 1:
            return sides
    raise InvalidArgumentError(
        f"found `{name}` {shown(size)}, expected a width and a height in pixels, such as 1920x1280"
    )


def _checked_camera(name: str, camera: Any) -> str:
    if not isinstance(camera, str):
        raise InvalidArgumentError(
            f"found `{name}` {shown(camera)}, expected x,y,z,heading,pitch,fov as a text"
        )
    return camera


def _checked_style(name: str, style: Any) -> Style:
    if not isinstance(style, Style):
        raise InvalidArgumentError(f"found `{name}` {shown(style)}, expected a Style")
    return style


@dataclass(frozen=True, kw_only=True)
class ViewOptions(DrawnOptions):
    """Options of `Terrain.view`, which describes them."""

    size: tuple[int, int] = option(
        Kind(_checked_size, lambda text: [number_in(side) for side in text.split("x")], "WxH"),
        "Width and height of the picture or window, in pixels.",
        default=(960, 640),
        typed={"default": "1280x853"},
    )
    camera: str | None = option(
        Kind(_checked_camera, values="TEXT"),
        "x,y,z,heading,pitch,fov: position in the CRS, height in the file's unit; angles in"
        " degrees, heading from north, pitch upwards.",
    )
    bounds: Sequence[float] | None = option(BOUNDS, "Area to show, in the CRS.")
    max_pixel_error: float = option(
        number(above=0),
        "Largest distance on screen from the full terrain, in pixels.",
        default=1.0,
        typed={"has_range": True},
    )
    drape: str | None = option(
        PATH,
        "Orthophoto to drape over the terrain, warped to its CRS: a file, a URL or the URL of"
        " tiles, https://.../{z}/{x}/{y}.png.",
        typed={"metavar": "IMAGE"},
    )
    style: Style | None = option(Kind(_checked_style))

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("error", self.error, mode_class(self.mode).errors)
        if self.camera is not None and self.bounds is not None:
            raise InvalidArgumentError("found both `camera` and `bounds`, expected one of them")
        self.of_mode()
