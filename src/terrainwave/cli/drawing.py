"""Options, style and notes that render and view share."""

from collections.abc import Callable
from typing import Any

import click

from terrainwave.cli.options import add_options, declared
from terrainwave.cli.output import print_note
from terrainwave.render import DEFAULT_MAX_BYTES
from terrainwave.render.look.colorings import AUTO
from terrainwave.render.look.style import Style
from terrainwave.render.window.view_options import ViewOptions

# Metres: lower land is worth a note.
_SEEN_DEPTH = -1.0


def drawing(command: Callable[..., Any]) -> Callable[..., Any]:
    return add_options(
        command,
        click.option("--threads", "n_workers", type=click.IntRange(1, 64), default=2,
                     show_default=True, help="Threads that read and decode."),
        click.option("--memory", type=click.IntRange(min=64), default=DEFAULT_MAX_BYTES >> 20,
                     show_default=True, help="Memory to use on the GPU, in MiB."),
        declared(Style),
        declared(ViewOptions, "drape"),
        declared(ViewOptions, "error", "radius"),
        declared(ViewOptions, "max_pixel_error", "max_pixel_error"),
        declared(ViewOptions, "mode", "detail"),
        declared(ViewOptions, "size", "bounds"),
    )  # fmt: skip


def announce_preparation(options: dict[str, Any]) -> None:
    from terrainwave.render.modes import mode_class

    preparation = mode_class(options["mode"]).preparation(options["error"])
    if preparation is not None:
        click.echo(preparation, err=True)


def suggest_exaggeration(frame: Any) -> None:
    factor = frame.suggested_exaggeration
    if factor is not None:
        print_note(
            f"the heights are too small to be seen at the raster's extent: add --exaggeration"
            f" {factor:g} to see them"
        )


def note_dry_land(scene: Any, style: Any) -> None:
    frame = scene.scene.frame
    lowest = min(frame.heights, key=frame.to_metres)
    if not style.is_absolute(frame.body) or style.sea_level != AUTO:
        return
    if frame.to_metres(lowest) <= _SEEN_DEPTH and not scene.water.cells.any():
        print_note(
            f"heights from {lowest:g} to 0 are drawn as land, because none is level at 0 or below"
            " -450 m: add --sea-level 0 to draw water there"
        )


def style_of(options: dict[str, Any]) -> Style:
    return Style(
        **{one.name: options.pop(one.name) for one in Style.options() if one.metadata["help"]}
    )
