"""No pixel of hatch or background where there is data: ``python -m benchmarks.outlines DEM.tif …``.

Of each raster a picture from above and one from its side, in each mode at each τ, beside one of all
samples (mode full). Voids and the outside have a colour of their own. By the papers' errors, which
bound nothing, from above alone, where errors hardly move a pixel.

`inside` counts pixels that show no ground although all parts of those of the full picture do, and
of all around them, as far as τ and a pixel; `outside` counts the other way round: mostly skirts
inside of the terrain, seen from the side where this style draws no walls. The full picture has
8 x 8 parts to a pixel, as voids may be smaller than one. Of mode loose, τ is what its meshes are
worth there.
"""

import math
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
from scipy import ndimage

import terrainwave
from benchmarks import common
from terrainwave.render.gpu.canvas import Canvas, create_context
from terrainwave.render.look.style import Style
from terrainwave.render.modes import MODES, mode_class
from terrainwave.render.scene.camera import Camera, home, top_view

LOUD = (255, 0, 255)
STYLE = Style(background=LOUD, coloring="flat")
TAUS = (1.0, 4.0, 16.0)
PARTS = 8
MAX_ERROR = 1.0

# `ground` are the pixels of the full picture that show it; `kept` is the τ that the mode states.
Row = namedtuple("Row", "raster mode error camera tau kept ground inside outside seconds")


def is_loud(image: np.ndarray) -> np.ndarray:
    """Return the pixels that show no ground."""
    found: np.ndarray = (image == LOUD).all(axis=2)
    return found


def cameras_of(canvas: Canvas) -> dict[str, Camera]:
    """Return the places to look from."""
    box = canvas.scene.frame.box
    return {"above": top_view(box, canvas.viewport), "side": home(box, canvas.viewport)}


def measure(
    dem: Path, size: tuple[int, int], modes: tuple[str, ...], context: Any, folder: Path
) -> Iterator[Row]:
    """Yield the pictures of a raster."""
    file = folder / f"{dem.stem}.twz"
    if not file.exists():
        terrainwave.compress(dem, file, max_error=MAX_ERROR, verify=False)
    options = {"samples": 0, "context": context}
    with terrainwave.open(file) as terrain:
        fine = size[0] * PARTS, size[1] * PARTS
        with Canvas(terrain, fine, mode="full", **options) as full:
            cameras = cameras_of(full)
            parts = {
                name: parts_of(is_loud(full.picture(camera, STYLE)[0]))
                for name, camera in cameras.items()
            }
        for mode in modes:
            for error in ("measured", "paper"):
                if error not in mode_class(mode).errors:
                    continue
                with Canvas(terrain, size, mode=mode, error=error, **options) as canvas:
                    names = cameras if error == "measured" else ["above"]
                    for name in names:
                        for tau in TAUS:
                            started = time.perf_counter()
                            image, frames = canvas.picture(
                                cameras[name], STYLE, max_pixel_error=tau
                            )
                            seconds = time.perf_counter() - started
                            moved = max(tau, frames.tau) if error == "measured" else tau
                            yield Row(
                                dem.stem, mode, error, name, tau, round(frames.tau, 3),
                                *counts(parts[name], is_loud(image), moved), round(seconds, 2),
                            )  # fmt: skip


def parts_of(fine: np.ndarray) -> np.ndarray:
    """Return of each pixel how many of its parts show no ground."""
    n_rows, n_cols = (n // PARTS for n in fine.shape)
    counted: np.ndarray = fine.reshape(n_rows, PARTS, n_cols, PARTS).sum(axis=(1, 3))
    return counted


def counts(parts: np.ndarray, found: np.ndarray, moved: float) -> tuple[int, int, int]:
    """Return pixels of ground, and those that lack it or have too much, `moved` pixels away."""
    far = min(math.ceil(moved) + 1, max(parts.shape))
    square = np.ones((2 * far + 1, 2 * far + 1), dtype=bool)
    ground = ~ndimage.binary_dilation(parts > 0, square)
    nothing = ~ndimage.binary_dilation(parts < PARTS**2, square)
    return int((parts == 0).sum()), int((found & ground).sum()), int((~found & nothing).sum())


@common.command("outlines.csv")
@common.rasters_argument
@common.option("--size", default="320x240")
@common.option("--modes", cls=common.ListOption, type=click.Choice(MODES), default=MODES)
def main(paths: list[Path], size: str, modes: tuple[str, ...], folder: Path, out: Path) -> None:
    """Measure, print and write the CSV."""
    width, height = (int(part) for part in size.split("x"))
    context = create_context()
    common.write_rows(
        out,
        (row for dem in paths for row in measure(dem, (width, height), modes, context, folder)),
    )


if __name__ == "__main__":
    main()
