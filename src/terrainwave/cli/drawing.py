"""Options, style and notes that render and view share."""

import re
from collections.abc import Callable
from typing import Any

import click

from terrainwave.cli.options import RADIUS_OPTION, Name, Numbers, SeaLevel, add_options
from terrainwave.cli.output import print_note
from terrainwave.render import DEFAULT_MAX_BYTES
from terrainwave.render.look.colorings import AUTO, MEANINGS, RAMP_NAMES
from terrainwave.render.modes import MODES

RAMPS = click.Choice([AUTO, *RAMP_NAMES])
# One line each: the blank lines keep click from joining them.
COLORING_HELP = "Meaning of the colours.\n\n\b\n" + "\n".join(
    f"{name}: {meaning}" for name, meaning in MEANINGS.items()
)
# Metres: lower land is worth a note.
_SEEN_DEPTH = -1.0
POSITIVE = click.FloatRange(min=0, min_open=True)


class Size(click.ParamType):
    """Width and height in pixels: 1920x1280."""

    name = "WxH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        """Return both numbers."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", value)
        if not match or 0 in (int(match[1]), int(match[2])):
            self.fail(f"found {value}, expected a size such as 1920x1280", param, ctx)
        return int(match[1]), int(match[2])


class Color(click.ParamType):
    """Red, green and blue as six hexadecimal digits."""

    name = "RRGGBB"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int, int]:
        """Return the three numbers."""
        if isinstance(value, tuple):
            return value
        if not re.fullmatch("#?[0-9a-fA-F]{6}", value):
            self.fail(f"found {value}, expected six hexadecimal digits", param, ctx)
        red, green, blue = bytes.fromhex(value.removeprefix("#"))
        return red, green, blue


def _as_int(_: Any, __: Any, value: str | None) -> int | None:
    return None if value is None else int(value)


def drawing(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that render and view share."""
    return add_options(
        command,
        click.option("--threads", "n_workers", type=click.IntRange(1, 64), default=2,
                     show_default=True, help="Threads that read and decode."),
        click.option("--memory", type=click.IntRange(min=64), default=DEFAULT_MAX_BYTES >> 20,
                     show_default=True, help="Memory to use on the GPU, in MiB."),
        click.option("--background", type=Color(), help="Colour to draw instead of the sky."),
        click.option("--wireframe", is_flag=True, help="Draw edges only."),
        click.option("--haze", type=click.FloatRange(0, 1), default=0.25, show_default=True,
                     help="Haze in the distance; 0 is none."),
        click.option("--sun", type=Numbers("azimuth,altitude", float), default="315,38",
                     show_default=True, help="Direction of the light, in degrees."),
        click.option("--sea-level", type=SeaLevel(), default=AUTO, show_default=True,
                     help="Height up to which absolute colours show water, in the file's unit, or"
                     " none. auto: level ground at 0 is water, and ground below 0 that is connected"
                     " to depths of more than 450 m."),
        click.option("--ramp", type=RAMPS, default=AUTO, show_default=True,
                     help="Relative colours. Default: those of the planet or moon. cividis suits"
                     " colour-blind readers."),
        click.option("--coloring", type=click.Choice(list(MEANINGS)), metavar="NAME",
                     default="auto", show_default=True, help=COLORING_HELP),
        click.option("--drape", type=Name(), metavar="IMAGE",
                     help="Orthophoto to drape over the terrain, warped to its CRS: a file, a URL"
                     " or the URL of tiles, https://.../{z}/{x}/{y}.png."),
        RADIUS_OPTION,
        click.option("--exaggeration", type=POSITIVE, default=1.0, show_default=True,
                     help="Multiply heights by this factor."),
        click.option("--error", type=click.Choice(["measured", "paper", "coefficient"]),
                     default="measured", show_default=True,
                     help="Errors and formula that select blocks. coefficient: wavelet"
                     " coefficients, for mode rqt and files of method cdf53."),
        click.option("--max-pixel-error", type=POSITIVE, default=1.0, show_default=True,
                     help="Largest distance on screen from the full terrain, in pixels."),
        click.option("--detail", type=POSITIVE, metavar="FACTOR",
                     help="With --mode batched --error paper: the error of a level is this factor"
                     " times its spacing. Default: 0.5."),
        click.option("--order", type=click.Choice(["2", "4"]), callback=_as_int,
                     help="With --mode batched: order of the filter of levels. Default: 4."),
        click.option("--stepwise", is_flag=True,
                     help="With --mode dynamic or vertex-texture: change one height of the quadtree"
                     " in each frame."),
        click.option("--tree", type=click.Choice([str(1 << k) for k in range(1, 9)]),
                     callback=_as_int, metavar="SAMPLES",
                     help="With --mode dynamic or vertex-texture: samples on each side of a"
                     " quadtree, a power of two from 2 to 256. Default: 16."),
        click.option("--orientation", is_flag=True,
                     help="With --mode adaptive, batched or loose: draw fewer triangles where the"
                     " camera looks down, because errors are vertical. Shading becomes coarser"
                     " there, too."),
        click.option("--mode", type=click.Choice(MODES), default="adaptive", show_default=True,
                     help="How to draw the terrain: docs/viewing.md describes the modes."),
        click.option("--bounds", type=Numbers("left,bottom,right,top", float),
                     help="Area to show, in the CRS."),
        click.option("--camera", help="x,y,z,heading,pitch,fov: position in the CRS, height in the"
                     " file's unit; angles in degrees, heading from north, pitch upwards."),
        click.option("--size", type=Size(), default="1280x853", show_default=True,
                     help="Width and height of the picture or window, in pixels."),
    )  # fmt: skip


def announce_preparation(options: dict[str, Any]) -> None:
    """Explain the wait if a mode reads every sample before its first picture."""
    from terrainwave.render.modes import mode_class

    preparation = mode_class(options["mode"]).preparation(options["error"])
    if preparation is not None:
        click.echo(preparation, err=True)


def suggest_exaggeration(frame: Any) -> None:
    """Print a note if the relief is too small to be visible."""
    factor = frame.suggested_exaggeration
    if factor is not None:
        print_note(
            f"the heights are too small to be seen at the raster's extent: add --exaggeration"
            f" {factor:g} to see them"
        )


def note_dry_land(scene: Any, style: Any) -> None:
    """Print a note if ground below the sea is drawn as land by guess."""
    frame = scene.scene.frame
    lowest = min(frame.heights, key=frame.to_metres)
    if not style.is_absolute(frame.body) or style.sea_level != AUTO:
        return
    if frame.to_metres(lowest) <= _SEEN_DEPTH and not scene.water.cells.any():
        print_note(
            f"heights from {lowest:g} to 0 are drawn as land, because none is level at 0 or below"
            " -450 m: add --sea-level 0 to draw water there"
        )


def style_of(options: dict[str, Any]) -> Any:
    """Remove the style options and return the style."""
    from terrainwave.render.look.style import Style

    names = ("coloring", "ramp", "sea_level", "sun", "haze", "wireframe", "background")
    return Style(**{name: options.pop(name) for name in names})
