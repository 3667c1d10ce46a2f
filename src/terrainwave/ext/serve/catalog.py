"""List of a page's terrains (terrains.json), served or published."""

import re
from itertools import islice
from typing import Any

from terrainwave._version import __version__
from terrainwave.arguments import in_one_line
from terrainwave.errors import InvalidHeightsError
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.lonlat import Globe
from terrainwave.place.ellipsoid import EARTH
from terrainwave.render.look.colorings import AUTO, NO_SEA
from terrainwave.render.look.ramps import RAMPS, ramp_stops

# Names of tags that say where data are from, and whose they are.
_ORIGIN = re.compile(
    r"licen[cs]e|^lic$|copyright|rights|attribution|credit|source|author|artist|provider"
    r"|publisher|producer|citation|doi|sensor|organi[sz]ation",
    re.IGNORECASE,
)
_N_TAGS, _LONGEST_TAG = 8, 400


def describe(
    name: str,
    globe: Globe,
    encoding: str = tiling.MAPBOX,  # of the terrain-RGB tiles that the page has
    # {"auto", "none"}; height in metres below which the Earth's colours are the sea's, as in
    # `ramp_colors`
    sea_level: float | str = AUTO,
) -> dict[str, Any]:
    info, (lowest, highest) = globe.terrain.info(), globe.height_range
    is_earth = globe.ellipsoid == EARTH
    sea = sea_level if is_earth and sea_level != NO_SEA else None
    return {
        "name": name,
        "bounds": list(globe.extent),
        "maxzoom": tiling.max_zoom(globe),
        "encoding": encoding,
        "lowest": lowest,
        "highest": highest,
        "error": globe.effective_error,
        "units": globe.units,
        "bytes": info.n_bytes,
        "rows": info.n_rows,
        "columns": info.n_cols,
        "bits_per_sample": info.bits_per_sample,
        "method": info.method,
        "on_earth": is_earth,
        "ramp": "tints" if is_earth else "grey",
        "ramps": {ramp: ramp_stops(ramp, lowest, highest, sea) for ramp in RAMPS},
        "origin": origin_of({**info.tags, **info.band_tags}),
        "version": __version__,
    }


def origin_of(tags: dict[str, str]) -> dict[str, str]:
    told = {name: text for name, text in tags.items() if text and _ORIGIN.search(name)}
    return {
        in_one_line(name)[:_LONGEST_TAG]: in_one_line(text)[:_LONGEST_TAG]
        for name, text in islice(told.items(), _N_TAGS)
    }


def layer_names(paths: list[str]) -> dict[str, str]:
    """Return {name in URLs: path}; raise `InvalidHeightsError` for two files of one name."""
    names: dict[str, str] = {}
    for path in paths:
        stem = re.split(r"[/\\]", path.split("?")[0])[-1].rsplit(".", 1)[0]
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", stem).strip("-") or "terrain"
        if name in names:
            raise InvalidHeightsError(
                f"{names[name]} and {path} would both be served as {name}: rename one"
            )
        names[name] = path
    return names
