"""Is each picture within what its caption says? ``make long DATA=DIR``.

Of each raster, compressed by default, one picture by `terrainwave render`'s own camera, with
default errors, walls and all else, in each mode at each τ. `caption` is what `render` prints,
`within` the pixels in it, `measured` what ``--measure`` finds: the largest distance on screen of
the surface as drawn from a decoded height in view. `limit` says whether the mode has one at all.

A picture is `bad` if `measured` is more than `within`, or if the caption says more than 2 τ and not
that there is no limit. Pictures that are in the CSV already are not drawn again: an interrupted run
goes on. `date` and `commit` are those of the row.
"""

import datetime
import time
from collections import namedtuple
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any

import click

import terrainwave
from benchmarks import common
from terrainwave.render.gpu.canvas import Canvas, create_context
from terrainwave.render.look.style import Style
from terrainwave.render.modes import MODES
from terrainwave.render.window.pictures import choose_camera, fly_through

TAUS = (1.0, 2.0, 4.0)

Row = namedtuple(
    "Row", "date commit raster mode tau size caption limit within measured bad triangles seconds"
)
Picture = tuple[str, str, float, str]


def is_bad(tau: float, limit: bool, within: float | None, measured: float) -> bool:
    """Say whether a caption says less than holds, or more than 2 τ of a mode with a limit."""
    if within is None:
        return limit
    return measured > within or (limit and within > 2 * tau)


def measure(
    dem: Path, size: str, modes: tuple[str, ...], taus: tuple[float, ...], context: Any,
    folder: Path, done: Container[Picture] = (),
) -> Iterator[Row]:  # fmt: skip
    """Yield the pictures of a raster that are not done."""
    file = folder / f"{dem.stem}.twz"
    about = datetime.datetime.now(datetime.UTC).date(), common.describe_machine()["commit"]
    width, height = (int(part) for part in size.split("x"))
    for mode in modes:
        missing = [tau for tau in taus if (dem.stem, mode, tau, size) not in done]
        if not missing:
            continue
        if not file.exists():
            terrainwave.compress(dem, file)
        with (
            terrainwave.open(file) as terrain,
            Canvas(terrain, (width, height), mode=mode, context=context) as canvas,
        ):
            camera = choose_camera(canvas.scene.frame, canvas.viewport)
            for tau in missing:
                started = time.perf_counter()
                ((_, drawn),) = fly_through(canvas, [camera], 1, Style(), tau, measure=True)
                limit = canvas.scene.mode.has_limit
                within, measured = drawn["max_pixel_error"], drawn["measured_pixel_error"]
                yield Row(
                    *about, dem.stem, mode, tau, size, drawn["caption"], limit,
                    "" if within is None else round(within, 6), round(measured, 6),
                    is_bad(tau, limit, within, measured), drawn["n_triangles"],
                    round(time.perf_counter() - started, 1),
                )  # fmt: skip


@common.command("captions.csv")
@common.rasters_argument
@common.option("--size", default="1280x720")
@common.choices_option("--modes", of=MODES)
@common.option("--taus", cls=common.ListOption, type=float, default=TAUS)
def main(paths, size, modes, taus, folder, out) -> None:
    """Draw, measure, print and write the CSV; exit with 1 if a caption is bad."""
    rows = common.read_rows(out)
    done = {(row["raster"], row["mode"], float(row["tau"]), row["size"]) for row in rows}
    context = create_context()
    # Small ones first.
    dems = sorted(paths, key=lambda dem: dem.stat().st_size)
    common.write_rows(
        out,
        (row for dem in dems for row in measure(dem, size, modes, taus, context, folder, done)),
        append=True,
    )
    bad = [row for row in common.read_rows(out) if row["bad"] == "True"]
    for row in bad:
        click.echo(f"bad: {row}")
    raise SystemExit(1 if bad else 0)


if __name__ == "__main__":
    main()
