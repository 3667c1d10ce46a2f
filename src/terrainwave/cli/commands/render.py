"""The command render: pictures without a screen."""

import json
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from terrainwave.arguments import (
    PICTURE_ENDINGS,
    count_of,
)
from terrainwave.cli.drawing import (
    announce_preparation,
    drawing,
    note_dry_land,
    style_of,
    suggest_exaggeration,
)
from terrainwave.cli.options import (
    Input,
    Numbers,
    Target,
)
from terrainwave.cli.output import (
    Bar,
    Command,
    announce_compiling,
    plain,
    print_note,
    reading,
)
from terrainwave.cli.streams import STREAM, printing_beside, written


@click.command(cls=Command)
@click.argument("file", type=Input())
@click.argument("target", type=Target(PICTURE_ENDINGS))
@drawing
@click.option(
    "--bounds", type=Numbers("left,bottom,right,top", float), help="Show this, in the CRS."
)
@click.option("--legend", is_flag=True, help="Draw what the colours say, with units.")
@click.option("--scale-bar", is_flag=True, help="Draw a length that holds in the middle.")
@click.option("--samples", type=click.IntRange(0, 16), default=4, show_default=True,
              help="Per pixel, against jagged edges.")  # fmt: skip
@click.option(
    "--stats",
    type=Target((".json",), or_stdout=False),
    help="Write what was drawn to this JSON file.",
)
@click.option("--flight", type=click.File("r", encoding="utf-8"),
              help="JSON list of cameras to fly along: TARGET gets numbers.")  # fmt: skip
@click.option("--frames", "n_frames", type=click.IntRange(1), default=60, show_default=True)
@click.option("--overwrite", is_flag=True, help="Replace existing files.")
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
def render(
    file: str,
    target: str,
    size: tuple[int, int],
    camera: str | None,
    bounds: tuple[float, ...] | None,
    max_pixel_error: float,
    memory: int,
    stats: str | None,
    flight: Any,
    n_frames: int,
    legend: bool,
    scale_bar: bool,
    overwrite: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Draw FILE (.twz) to the picture TARGET (.png; - is stdout), without a screen."""
    import terrainwave
    from terrainwave.render.gpu.canvas import Canvas
    from terrainwave.render.look.marks import check_marks
    from terrainwave.render.scene.frame import check_drawable
    from terrainwave.render.window.pictures import (
        choose_camera,
        fly_through,
        heights_within,
        read_flight,
    )

    if flight is not None and target == STREAM:
        raise click.UsageError("found - as TARGET and --flight, expected a name: there are several")
    announce_compiling(quiet=quiet)
    if not quiet:
        announce_preparation(options)
    started = time.perf_counter()
    all_drawn: list[dict[str, Any]] = []
    with ExitStack() as stack:
        stack.enter_context(reading(file))
        terrain = stack.enter_context(terrainwave.open(file))
        check_drawable(terrain)
        within = None if bounds is None else heights_within(terrain, bounds)
        style = style_of(options)
        check_marks(size, style, legend=legend, scale_bar=scale_bar)
        with Bar(quiet=quiet) as bar:
            scene = stack.enter_context(
                Canvas(terrain, size, max_bytes=memory << 20, progress=bar, **options)
            )
        style.check_body(scene.scene.frame.body)
        suggest_exaggeration(scene.scene.frame)
        note_dry_land(scene, style)
        if flight is None:
            cameras, n_frames = (
                [choose_camera(scene.scene.frame, scene.viewport, camera, bounds, within)],
                1,
            )
        else:
            cameras = read_flight(flight.read(), scene.scene.frame)
        names = _names(target, 1 if flight is None else n_frames, flight is not None)
        pictures = fly_through(
            scene, cameras, n_frames, style, max_pixel_error, legend=legend, scale_bar=scale_bar
        )
        for name, (image, drawn) in zip(names, pictures, strict=True):
            with written(name, ".png") as path:
                _write_png(path, image, overwrite)
            all_drawn.append(drawn)
    if stats is not None:
        _write(
            stats, json.dumps(all_drawn if flight else all_drawn[0], indent=2).encode(), overwrite
        )
    last = all_drawn[-1]
    for problem in last["problems"]:
        print_note(f"drawn coarser: {problem}")
    if not quiet:
        seconds = time.perf_counter() - started
        with printing_beside(target):
            _print_picture(names[-1], last, seconds)


def _print_picture(name: str, drawn: dict[str, Any], seconds: float) -> None:
    click.echo(
        f"{plain(name)}: {count_of(drawn['n_triangles'], 'triangle')} of"
        f" {count_of(drawn['n_blocks'], 'block')} within {drawn['max_pixel_error']:.3g} pixels,"
        f" {seconds:.1f} s on {drawn['renderer']}"
    )
    click.echo(f"--camera {drawn['camera']}")


def _names(target: str, n_frames: int, is_numbered: bool) -> list[str]:
    if not is_numbered:
        return [target]
    path = Path(target)
    digits = max(4, len(str(n_frames)))
    return [
        str(path.with_name(f"{path.stem}-{number:0{digits}}{path.suffix}"))
        for number in range(n_frames)
    ]


def _write_png(target: str, image: Any, overwrite: bool) -> None:
    from terrainwave.render.look.png import encode_png

    _write(target, encode_png(image), overwrite)


def _write(target: str, data: bytes, overwrite: bool) -> None:
    from terrainwave.container.publish import publish

    with publish(target, overwrite) as part:
        part.file.write(data)
