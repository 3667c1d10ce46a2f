"""`Terrain.plot` and `Terrain.view`: a map with matplotlib; a window, or else a picture."""

import os
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import PICTURE_ENDINGS, check_ending
from terrainwave.container.targets.publication import publish
from terrainwave.errors import TerrainwaveError, TerrainwaveWarning
from terrainwave.export.plot import add_colour_bar, colours_of_heights, label_axes
from terrainwave.extras import need, with_extra
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import IDENTITY
from terrainwave.place.bodies import EARTH
from terrainwave.place.position import axis_labels
from terrainwave.render.look.style import Style
from terrainwave.render.scene.frame import check_drawable, frame_of

# Samples along the longer side of a map: more than a figure has pixels.
_MAP_SIDE = 1200


@dataclass(frozen=True)
class Picture:
    """A picture for notebooks: uint8 (height, width, 3).

    `camera` is the line for ``camera=`` and ``--camera`` that gives this view.
    """

    pixels: NDArray[np.uint8]
    camera: str

    def _repr_png_(self) -> bytes:
        from terrainwave.render.look.png import encode_png

        return encode_png(self.pixels)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the picture as PNG; the name must end in ``.png``."""
        check_ending(path, PICTURE_ENDINGS)
        with publish(Path(path), overwrite) as part:
            part.file.write(self._repr_png_())


def plot(terrain: TerrainFile, ax: Any, *, cmap: str | None, shade: float, bounds: Any) -> Any:
    pyplot = need("matplotlib.pyplot", extra="demo")
    colors = need("matplotlib.colors", extra="demo")
    level = -1
    while (
        level > -terrain.n_levels
        and max(terrain.region(bounds=bounds, level=level - 1).shape) >= _MAP_SIDE
    ):
        level -= 1
    region = terrain.region(bounds=bounds, level=level)
    heights = terrain.read(region, level=level, masked=True)
    raster = terrain.raster_info
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)  # a map shows its assumptions itself
        frame = frame_of(terrain)
    physical: Any = heights.astype(np.float64) * raster.scale + raster.offset
    if ax is None:
        _, ax = pyplot.subplots()
    a, _, c, _, e, f = terrain.transform_of(level, region)[:6]
    x, y = c + a * region.n_cols, f + e * region.n_rows
    low, high = (physical.min(), physical.max()) if physical.count() else (0.0, 1.0)
    norm = colors.Normalize(low, high if high > low else low + 1)
    is_earth = frame.body == EARTH
    colours = colours_of_heights(cmap, norm.vmin, norm.vmax, frame.metres[2], is_earth=is_earth)
    rgb = colours(norm(physical.filled(low)))
    filled = physical.filled(float(physical.mean()) if physical.count() else 0.0)
    per_x, per_y, per_height = frame.metres
    light = np.ones(region.shape)
    if min(region.shape) > 1:  # a single line has no slopes
        light = colors.LightSource(azdeg=315, altdeg=45).hillshade(
            filled * per_height, dx=abs(a) * per_x or 1.0, dy=abs(e) * per_y or 1.0
        )
    rgb[..., :3] *= 1 - shade * (1 - light[..., None])
    rgb[..., 3] = ~np.ma.getmaskarray(physical)
    ax.imshow(rgb, extent=(min(c, x), max(c, x), min(y, f), max(y, f)), origin="upper")
    if x < c or y > f:  # the first row to the south, or the first column to the east
        ax.images[-1].set_data(rgb[:: -1 if y > f else 1, :: -1 if x < c else 1])
    ax.set_aspect(per_y / per_x)
    is_placed = tuple(raster.transform) != IDENTITY
    label_axes(ax, *axis_labels(terrain.crs, is_placed=is_placed))
    add_colour_bar(ax, norm, colours, terrain.units, terrain.height_unit.word)
    return ax


@with_extra("view")
def view(
    terrain: TerrainFile,
    *,
    size: tuple[int, int],
    camera: str | None,
    bounds: Any,
    style: Style,
    max_pixel_error: float,
    **options: Any,
) -> Picture | None:
    from terrainwave.render.window.viewer import run

    check_drawable(terrain)
    if not _in_notebook():
        try:
            run(
                terrain, size=size, camera=camera, bounds=bounds, style=style,
                max_pixel_error=max_pixel_error, **options,
            )  # fmt: skip
            return None
        except TerrainwaveError:
            # No display, no toolkit: problems of the terrain itself are raised again below.
            pass
    from terrainwave.render.gpu.canvas import Canvas
    from terrainwave.render.scene.camera import format_camera
    from terrainwave.render.window.pictures import area_within, choose_camera

    area = None if bounds is None else area_within(terrain, bounds)
    with Canvas(terrain, size, **options) as canvas:
        frame = canvas.scene.frame
        style.check_body(frame.body)
        chosen = choose_camera(frame, canvas.viewport, camera, area)
        pixels, _ = canvas.picture(chosen, style, max_pixel_error=max_pixel_error)
    return Picture(pixels, format_camera(chosen, frame))


def _in_notebook() -> bool:
    """Return whether a notebook's kernel runs this, which a window would block."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ == "ZMQInteractiveShell"
