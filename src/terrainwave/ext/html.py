"""Notebook display of a `Terrain`: a static picture and a table, without scripts.

All text may come from an untrusted file: it is escaped and stripped of control characters.
"""

import base64
import html
import math
import warnings

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import crs_name, in_one_line
from terrainwave.errors import TerrainwaveError, TerrainwaveWarning
from terrainwave.file import TerrainFile
from terrainwave.place.bodies import EARTH
from terrainwave.place.meaning import PLURALS
from terrainwave.render.look.png import encode_png
from terrainwave.render.look.ramps import N_COLORS, ramp_colors
from terrainwave.render.look.water import DEEP, find_water, may_have_water, waves_of
from terrainwave.render.scene.frame import Frame, frame_of

_SIDE = 320
_VOID = 238
# From the north-west, 45 degrees above the horizon, as is usual on maps.
_LIGHT = np.array([-0.5, -0.5, np.sqrt(0.5)])
_AMBIENT = 0.4
# Slopes are stretched until the steepest twentieth exceeds this, so that relief is visible on
# plains.
_STEEP = 0.8
_LONGEST_TEXT = 200


def terrain_html(terrain: TerrainFile) -> str:
    try:
        data = base64.b64encode(encode_png(picture(terrain))).decode()
        image = (
            f'<img alt="shaded relief" src="data:image/png;base64,{data}"'
            ' style="image-rendering:auto;max-width:100%">'
        )
    except TerrainwaveError as error:  # damaged or closed: the table only needs the header
        image = f"<p>no picture: {_escaped(error)}</p>"
    rows = "".join(
        f'<tr><th style="text-align:left">{name}</th>'
        f'<td style="text-align:left">{_escaped(value)}</td></tr>'
        for name, value in _rows(terrain)
    )
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">'
        f"{image}<table><tbody>{rows}</tbody></table></div>"
    )


def _rows(terrain: TerrainFile) -> list[tuple[str, str]]:
    info = terrain.info()
    unit = f" {info.units}" if info.units else ""
    heights = "none" if info.minimum is None else f"{info.minimum:.6g} to {info.maximum:.6g}{unit}"
    return [
        ("file", info.path),
        (
            "size",
            f"{info.n_rows:,} × {info.n_cols:,} samples, {info.dtype}; {info.n_bytes:,} bytes,"
            f" {info.ratio:.3g} times smaller than raw",
        ),
        (
            "bound",
            f"every height within {info.effective_error:.6g}{unit} of the original"
            + ("" if info.proved else ", by the encoder; the file was made without the proof"),
        ),
        (PLURALS[info.heights_are], heights),
        ("unit", info.units or "unknown"),
        ("levels", ", ".join(f"{rows} × {cols}" for rows, cols in info.level_shapes)),
        ("CRS", crs_name(info.crs)),
        ("bounds", ", ".join(f"{value:.10g}" for value in info.bounds)),
        ("meshes", info.mesh),
    ]


def _escaped(text: object) -> str:
    return html.escape(in_one_line(text)[:_LONGEST_TEXT])


def picture(terrain: TerrainFile) -> NDArray[np.uint8]:
    """Return a shaded relief with north up, uint8 (n_rows, n_cols, 3), voids light grey."""
    levels = range(terrain.n_levels)
    level = next((k for k in levels if max(terrain.level_shape(k)) >= _SIDE), levels[-1])
    n_rows, n_cols = terrain.level_shape(level)
    share = min(1.0, _SIDE / max(n_rows, n_cols))
    shape = max(1, round(n_rows * share)), max(1, round(n_cols * share))
    raw = terrain.read(level=level, out_shape=shape, resampling="average", masked=True)
    a, _, _, _, e, _ = terrain.raster_info.transform
    if e > 0 and terrain.crs:  # stored with the south first
        raw = raw[::-1]
    if a < 0:
        raw = raw[:, ::-1]
    valid = ~np.ma.getmaskarray(raw)
    heights = np.ma.getdata(raw).astype(np.float64)
    heights = heights * terrain.raster_info.scale + terrain.raster_info.offset
    image = np.full((*shape, 3), _VOID, dtype=np.uint8)
    if valid.any():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TerrainwaveWarning)  # a picture needs no warnings
            frame = frame_of(terrain)
        heights = (heights - frame.zero) * math.copysign(1, frame.metres[2])
        low, high = float(heights[valid].min()), float(heights[valid].max())
        heights[~valid] = low
        has_depth = _depths(terrain, frame, heights, valid)
        if has_depth.any():  # land below the sea has the colour of the shore
            colours = _ramp(heights, 0.0, max(high, 0.0), None)
            colours[has_depth] = _ramp(heights, low, high, 0.0)[has_depth]
        else:
            colours = _ramp(heights, low, high, None)
        image[valid] = (colours * _brightness(heights, valid)[:, :, None])[valid]
    return image


def _ramp(
    heights: NDArray[np.float64], low: float, high: float, sea: float | None
) -> NDArray[np.uint8]:
    share = np.clip((heights - low) / ((high - low) or 1.0), 0, 1)
    index = (share * (N_COLORS - 1)).astype(np.int64)
    colours: NDArray[np.uint8] = ramp_colors("tints", low, high, sea)[index]
    return colours


def _depths(
    terrain: TerrainFile, frame: Frame, heights: NDArray[np.float64], valid: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    if frame.body != EARTH or not may_have_water(terrain, frame):
        return np.zeros(heights.shape, dtype=np.bool_)
    metres, waves = heights * frame.error_metres, waves_of(terrain, frame)
    return (find_water(metres, valid, waves) == DEEP) & (metres <= waves)


def _brightness(heights: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    if min(heights.shape) < 2:
        return np.ones(heights.shape)
    south, east = np.gradient(heights)
    steep = float(np.quantile(np.hypot(south, east)[valid], 0.95))
    stretch = _STEEP / steep if steep > 0 else 0.0
    normal_length = np.sqrt(1 + (south * stretch) ** 2 + (east * stretch) ** 2)
    cosine = (_LIGHT[2] - stretch * (east * _LIGHT[0] + south * _LIGHT[1])) / normal_length
    return _AMBIENT + (1 - _AMBIENT) * np.clip(cosine, 0, 1)
