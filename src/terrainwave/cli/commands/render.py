"""Command render: pictures without a screen."""

import json
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import PICTURE_ENDINGS, count_of
from terrainwave.cli.drawing import (
    announce_preparation,
    drawing,
    note_dry_land,
    style_of,
    suggest_exaggeration,
)
from terrainwave.cli.options import Input, Target, on_command_line
from terrainwave.cli.output import Bar, Command, announce_compiling, plain, print_note, reading
from terrainwave.cli.streams import STREAM, printing_beside, written
from terrainwave.extras import with_extra


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
