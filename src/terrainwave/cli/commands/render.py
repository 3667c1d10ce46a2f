"""Command render: pictures without a screen."""

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import PICTURE_ENDINGS, count_of
from terrainwave.cli.options import Input, Target, add_options, declared, on_command_line
from terrainwave.cli.output import (
    Bar,
    Command,
    CommandWithoutTarget,
    announce_compiling,
    plain,
    print_note,
    reading,
)
from terrainwave.cli.streams import STREAM, printing_beside, written
from terrainwave.extras import with_extra
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


@click.command(cls=Command)
@click.argument("file", type=Input())
@click.argument("target", type=Target(PICTURE_ENDINGS))
@drawing
@click.option("--legend", is_flag=True, help="Draw a legend of the colours, with units.")
@click.option("--scale-bar", is_flag=True, help="Draw a scale bar, for the middle of the picture.")
@click.option("--samples", type=click.IntRange(0, 16), default=4, show_default=True,
              help="Samples per pixel, for smooth edges.")  # fmt: skip
@click.option(
    "--stats",
    type=Target((".json",), or_stdout=False),
    help="Write numbers about the picture to this JSON file.",
)
@click.option("--measure", is_flag=True,
              help="Measure how far the picture is from the decoded heights, in pixels. This reads"
              " all heights in view.")  # fmt: skip
@click.option("--flight", type=click.File("r", encoding="utf-8"),
              help="JSON list of cameras to fly along; pictures get numbers.")  # fmt: skip
@click.option("--frames", "n_frames", type=click.IntRange(1), default=60, show_default=True,
              help="Pictures of a flight.")  # fmt: skip
@click.option("--overwrite", is_flag=True, help="Replace existing files.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@with_extra("view")
def render(
    file: str,
    target: str,
    flight: Any,
    n_frames: int,
    stats: str | None,
    overwrite: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Draw FILE (.twz) to the picture TARGET (.png; - is stdout), without a screen."""
    if flight is not None and target == STREAM:
        raise click.UsageError(
            "found - as TARGET and --flight, expected a name: there are several pictures"
        )
    _refuse_unfit_for_flights(flight, options)
    announce_compiling(quiet=quiet)
    if not quiet:
        announce_preparation(options)
    started = time.perf_counter()
    names = [target] if flight is None else _numbered(target, n_frames)
    drawn = _draw(file, names, flight, overwrite=overwrite, quiet=quiet, **options)
    if stats is not None:
        _write(stats, json.dumps(drawn if flight else drawn[0], indent=2).encode(), overwrite)
    for problem in drawn[-1]["problems"]:
        print_note(f"drawn coarser: {problem}")
    if not quiet:
        with printing_beside(target):
            _print_picture(names[-1], drawn[-1], time.perf_counter() - started)


def _refuse_unfit_for_flights(flight: Any, options: dict[str, Any]) -> None:
    if flight is None and "n_frames" in on_command_line():
        raise click.UsageError("found --frames without --flight, expected both")
    for name in ("camera", "bounds"):
        if flight is not None and options[name] is not None:
            raise click.UsageError(f"found --flight and --{name}, expected one of them")


def _draw(
    file: str,
    names: list[str],
    flight: Any,
    *,
    camera: str | None,
    bounds: tuple[float, ...] | None,
    size: tuple[int, int],
    max_pixel_error: float,
    memory: int,
    measure: bool,
    overwrite: bool,
    quiet: bool,
    **options: Any,
) -> list[dict[str, Any]]:
    import terrainwave
    from terrainwave.render.gpu.canvas import Canvas
    from terrainwave.render.look.marks import check_marks
    from terrainwave.render.look.png import encode_png
    from terrainwave.render.scene.frame import check_drawable
    from terrainwave.render.window.pictures import (
        area_within,
        choose_camera,
        fly_through,
        read_flight,
    )

    marks = {name: options.pop(name) for name in ("legend", "scale_bar")}
    all_drawn = []
    with reading(file), terrainwave.open(file) as terrain, ExitStack() as stack:
        check_drawable(terrain)
        area = None if bounds is None else area_within(terrain, bounds)
        style = style_of(options)
        check_marks(size, style, **marks)
        with Bar(quiet=quiet) as bar:
            canvas = Canvas(terrain, size, max_bytes=memory << 20, progress=bar, **options)
            stack.enter_context(canvas)
        frame = canvas.scene.frame
        style.check_body(frame.body)
        suggest_exaggeration(frame)
        note_dry_land(canvas, style)
        if flight is None:
            cameras = [choose_camera(frame, canvas.viewport, camera, area)]
        else:
            cameras = read_flight(flight.read(), frame)
        pictures = fly_through(
            canvas, cameras, len(names), style, max_pixel_error, measure=measure, **marks
        )
        for name, (image, drawn) in zip(names, pictures, strict=True):
            with written(name, ".png") as path:
                _write(path, encode_png(image), overwrite)
            all_drawn.append(drawn)
    return all_drawn


def _print_picture(name: str, drawn: dict[str, Any], seconds: float) -> None:
    errors, measured = [drawn["caption"]], drawn["measured_pixel_error"]
    if measured is not None:
        errors.append(f"measured {measured:.3g} pixels")
    click.echo(
        f"{plain(name)}: {count_of(drawn['n_triangles'], 'triangle')} of"
        f" {count_of(drawn['n_blocks'], 'block')}, {'; '.join(errors)},"
        f" {seconds:.1f} s on {drawn['renderer']}"
    )
    click.echo(f"--camera {drawn['camera']}")


def _numbered(target: str, n_frames: int) -> list[str]:
    path = Path(target)
    digits = max(4, len(str(n_frames)))
    return [
        str(path.with_name(f"{path.stem}-{number:0{digits}}{path.suffix}"))
        for number in range(n_frames)
    ]


def _write(target: str, data: bytes, overwrite: bool) -> None:
    from terrainwave.container.targets.publication import publish

    with publish(target, overwrite) as part:
        part.file.write(data)


@click.command(cls=CommandWithoutTarget)
@click.argument("file", type=Input())
@drawing
@click.option(
    "--target-ms",
    type=click.FloatRange(min=0, min_open=True),
    help="Raise the pixel error if a frame takes longer than this, in milliseconds.",
)
@click.option("--fullscreen", is_flag=True, help="Fill the screen.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@with_extra("view")
def view(
    file: str,
    camera: str | None,
    max_pixel_error: float,
    memory: int,
    quiet: bool,
    **options: Any,
) -> None:
    """Open a window and fly over FILE (.twz) or its URL; H shows the keys and settings."""
    import terrainwave
    from terrainwave.render.scene.frame import frame_of
    from terrainwave.render.window.viewer import run

    announce_compiling(quiet=quiet)
    if not quiet:
        announce_preparation(options)
    with reading(file), terrainwave.open(file) as terrain:
        if options["exaggeration"] == 1.0:
            suggest_exaggeration(frame_of(terrain, radius=options["radius"]))
        line = run(
            terrain,
            camera=camera,
            style=style_of(options),
            max_pixel_error=max_pixel_error,
            max_bytes=memory << 20,
            **options,
        )
    if not quiet:
        click.echo(f"--camera {line}")
