"""Work of `terrainwave render`: one picture, or the pictures of a flight."""

import json
import math
import time
from collections.abc import Iterator, Sequence
from decimal import ROUND_CEILING, Context
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Region
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.marks import draw_marks, legend_of
from terrainwave.render.look.style import Style
from terrainwave.render.modes.mode import NO_PROMISE, Frames
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import (
    Camera,
    Viewport,
    along,
    format_camera,
    home,
    parse_camera,
    project,
)
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.walls import read_metres

_MAX_KEYS = 100_000
_FLIGHT = 'a JSON list of cameras: ["x,y,z,heading,pitch,fov", ...]'
_OVERVIEW_SIDE = 257
# Side of the parts that are measured at a time, in samples.
_MEASURED_SIDE = 2048


class ShownArea(NamedTuple):
    """A part of a terrain: bounds in its CRS, and the lowest and highest height within."""

    bounds: tuple[float, float, float, float]
    heights: tuple[float, float]


def choose_camera(
    frame: Frame,
    viewport: Viewport,
    camera: str | None = None,
    area: ShownArea | None = None,
) -> Camera:
    """Return the camera of a line, or one that shows an area or everything."""
    if camera is not None:
        if area is not None:
            raise InvalidArgumentError("found both `camera` and `bounds`, expected one of them")
        return parse_camera(camera, frame)
    low, high = frame.solid_box
    if area is not None:
        left, bottom, right, top = area.bounds
        ends = frame.to_local(np.array([[left, bottom, 0.0], [right, top, 0.0]]))
        z = np.sort(frame.to_metres(np.array(area.heights)) * frame.exaggeration)
        low, high = np.array([*ends[0, :2], z[0]]), np.array([*ends[1, :2], z[1]])
    return home((low, high), viewport)


def area_within(terrain: TerrainFile, bounds: Sequence[float]) -> ShownArea:
    """Return the area within bounds; its physical heights are approximate, from an overview."""
    left, bottom, right, top = bounds
    if not (left < right and bottom < top):
        raise InvalidArgumentError(
            f"found `bounds` {tuple(bounds)}, expected left < right and bottom < top"
        )
    level = -1
    region = terrain.region(bounds=bounds, level=level)
    while max(region.shape) > _OVERVIEW_SIDE and level > -terrain.n_levels:
        level -= 1
        region = terrain.region(bounds=bounds, level=level)
    # A coarse sample is void only if all around it is.
    raw, valid = terrain.read_with_mask(region, level=level, on_error="mask", voids="any")
    if not valid.any():
        raise InvalidHeightsError("the picture would show no terrain: all within `bounds` is void")
    raster = terrain.raster_info
    found = raw[valid].astype(np.float64) * raster.scale + raster.offset
    return ShownArea((left, bottom, right, top), (float(found.min()), float(found.max())))


def read_flight(text: str, frame: Frame) -> list[Camera]:
    """Return the cameras of a flight: a JSON list of camera lines."""
    try:
        keys = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidHeightsError(
            f"found a flight that is not JSON ({error}), expected {_FLIGHT}"
        ) from error
    if (
        not isinstance(keys, list)
        or not 1 <= len(keys) <= _MAX_KEYS
        or not all(isinstance(key, str) for key in keys)
    ):
        raise InvalidHeightsError(f"found a flight of another form, expected {_FLIGHT}")
    return [parse_camera(key, frame) for key in keys]


def fly_through(
    canvas: Canvas,
    cameras: list[Camera],
    n_frames: int,
    style: Style,
    max_pixel_error: float,
    *,
    legend: bool = False,
    scale_bar: bool = False,
    measure: bool = False,
) -> Iterator[tuple[NDArray[np.uint8], dict[str, Any]]]:
    """Yield pictures along a flight, with the `statistics` of each.

    `measure` adds `distance_on_screen`.
    """
    for number in range(n_frames):
        camera = along(cameras, number / max(n_frames - 1, 1))
        started = time.perf_counter()
        image, frames = canvas.picture(camera, style, max_pixel_error=max_pixel_error)
        seconds = time.perf_counter() - started
        if n_frames == 1 and canvas.is_blank():
            raise InvalidHeightsError(
                "the picture would show no terrain: what is in view is void, or `camera` looks"
                " elsewhere"
            )
        drawn = statistics(canvas, camera, frames, seconds, max_pixel_error)
        if measure:
            drawn["measured_pixel_error"] = distance_on_screen(canvas, style)
        if legend or scale_bar:
            image = with_marks(canvas, image, frames, style, legend=legend, scale_bar=scale_bar)
        yield image, drawn


def with_marks(
    canvas: Canvas,
    image: NDArray[np.uint8],
    frames: Frames,
    style: Style,
    *,
    legend: bool,
    scale_bar: bool,
) -> NDArray[np.uint8]:
    """Return the last picture with a legend, and a scale bar for its middle."""
    scene, scale = canvas.scene, None
    if scale_bar:
        scale = canvas.metres_per_pixel()
        if scale is None:
            raise InvalidHeightsError(
                "there is no scale to draw a bar of: the camera looks away from the terrain"
            )
    explained = None
    if legend:
        explained = legend_of(
            style,
            canvas.renderer.palette(frames, style),
            scene.frame,
            scene.terrain.units,
            has_voids=canvas.has_voids and style.draws_solid,
        )
    return draw_marks(image, legend=explained, metres_per_pixel=scale)


def distance_on_screen(canvas: Canvas, style: Style) -> float:
    """Return the distance of the last picture's surface from the decoded heights, pixels.

    At every valid sample of the full grid in view, as the camera sees it: between samples nothing
    is known. If pieces overlap, the furthest counts. Skirts, which close gaps between pieces, have
    no height at a sample. Reads the finest level of everything in view.
    """
    in_view, largest = canvas.samples_in_view(), 0.0
    for row in range(in_view.row, in_view.row + in_view.n_rows, _MEASURED_SIDE):
        for col in range(in_view.col, in_view.col + in_view.n_cols, _MEASURED_SIDE):
            region = Region(row, col, _MEASURED_SIDE, _MEASURED_SIDE).intersect(in_view)
            largest = max(largest, _distance_within(canvas, style, region))
    return largest


def _distance_within(canvas: Canvas, style: Style, region: Region) -> float:
    """Return `distance_on_screen` of a part of the full grid."""
    frame, camera, viewport = canvas.scene.frame, canvas.camera, canvas.viewport
    heights, valid = read_metres(canvas.scene.terrain, frame, region, -1)
    rows, cols = np.nonzero(valid)
    xy = frame.samples_to_local(rows + region.row, cols + region.col)
    z = heights[rows, cols] * frame.exaggeration
    asked = project(camera, viewport, np.column_stack([xy, z]))[:, :2]
    inside = ((asked >= 0) & (asked <= (viewport.width, viewport.height))).all(axis=1)
    largest = 0.0
    for drawn in canvas.drawn_heights(region, style):
        here = inside & ~np.isnan(drawn[rows, cols])
        seen = project(camera, viewport, np.column_stack([xy[here], drawn[rows, cols][here]]))
        away = np.linalg.norm(seen[:, :2] - asked[here], axis=1)
        largest = max(largest, float(np.nanmax(away, initial=0.0)))
    return largest


def caption(scene: Scene, tau: float, kept: float) -> str:
    """Return the bound of a picture with `Frames.tau`, at least the requested one, in words."""
    if not scene.mode.is_bound:
        return f"no limit with error {scene.mode.error}"
    if not scene.mode.has_limit:
        here = f", here within {_upwards(kept)} pixels" if math.isfinite(kept) else ""
        return f"no limit in mode {scene.mode.name}{here}"
    if tau >= NO_PROMISE:
        return "no limit: not all that the view needs fits"
    if kept <= 2 * tau:
        return f"within {_upwards(kept)} pixels"
    return f"within {_upwards(tau)} pixels where the file's finest meshes are"


def _upwards(pixels: float) -> str:
    """Return three digits of a limit, rounded up, so that a caption never understates it."""
    return f"{Context(prec=3, rounding=ROUND_CEILING).create_decimal(repr(pixels)).normalize():f}"


def statistics(
    canvas: Canvas, camera: Camera, frames: Frames, seconds: float, max_pixel_error: float
) -> dict[str, Any]:
    """Return the statistics of a drawn picture, as plain values."""
    kept = canvas.kept_error
    scene, info = canvas.scene, canvas.context.info
    return {
        "renderer": str(info["GL_RENDERER"]),
        "version": str(info["GL_VERSION"]),
        "size": [canvas.viewport.width, canvas.viewport.height],
        "camera": format_camera(camera, scene.frame),
        "mode": scene.mode.name,
        "error": scene.mode.error,
        "max_pixel_error": kept if math.isfinite(kept) else None,
        "caption": caption(scene, max(frames.tau, max_pixel_error), kept),
        "measured_pixel_error": None,
        "n_triangles": frames.n_triangles,
        "n_blocks": len(frames.nodes),
        "n_draw_calls": canvas.renderer.n_draw_calls,
        "gpu_bytes": canvas.n_bytes,
        "page_ms": scene.timings.page,
        "select_ms": scene.timings.select,
        "seconds": seconds,
        "problems": sorted(scene.problems.damaged.values()),
    }
