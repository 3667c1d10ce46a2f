"""Heights above the ellipsoid, from heights above a geoid or a tide, by PROJ's grids.

Only the operation that PROJ considers best for the area is used. If its grid is missing, PROJ
itself would take another one, and the same command would give other heights on other machines.
Nothing is downloaded.
"""

import os
import re
import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import AS_IS, ELLIPSOID
from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.place.bodies import EARTH as THE_EARTH
from terrainwave.place.description import GEOGRAPHIC, Vertical
from terrainwave.place.position import Place
from terrainwave.place.system import System, moved, need_pyproj
from terrainwave.place.units import vertical_of

Numbers = NDArray[np.float64]

# Longitude, latitude in degrees and ellipsoidal height in metres, of WGS 84.
_WGS_84 = "EPSG:4979"
# Points along each side of the raster used to find its area on the globe.
_N_ALONG = 9
# In PROJ's definitions and names of operations.
_GRIDS = re.compile(r"grids=(\S+)")
_NO_CHANGE = re.compile(r"^axis order change \(2D\) \+ | \+ axis order change \(2D\)")
# Description of heights computed from distances to the centre.
RADII = "radii less those of the ellipsoid"
_MOST_NAMED = 6


def note_as_is(crs_text: str | None) -> None:
    told = vertical_of(crs_text)
    if told is None or told.is_ellipsoidal:
        return
    warnings.warn(
        f"heights above {_reference(told)} are taken for heights above the ellipsoid; `vertical`"
        " ellipsoid converts them",
        TerrainwaveWarning,
        stacklevel=3,
    )


def _reference(told: Vertical) -> str:
    return told.datum or told.name


def describe_as_is(crs_text: str | None) -> dict[str, str]:
    told = vertical_of(crs_text)
    if told is None:
        return {"heights": AS_IS}
    return {"heights": AS_IS, "datum": "ellipsoid" if told.is_ellipsoidal else _reference(told)}


def describe_radii() -> dict[str, Any]:
    return {"heights": ELLIPSOID, "operation": RADII, "grids": []}


@dataclass(frozen=True)
class EllipsoidalHeights:
    """Conversion to heights above the ellipsoid.

    `description` is PROJ's name of the operation, empty if heights are above the ellipsoid already;
    `grids` are the files that it reads; `target` of `on_own_datum` is the WKT of the CRS with
    ellipsoidal heights.
    """

    description: str
    grids: tuple[str, ...]
    target: str | None
    _transformer: Any
    _place: Place
    _metres: float
    _has_radii: bool = False

    @classmethod
    def of_radii(cls, place: Place) -> Self:
        return cls(RADII, (), None, None, place, 1.0)

    def heights(self, x: Numbers, y: Numbers, heights: Numbers) -> Numbers:
        """Return metres above the ellipsoid of heights in metres, upwards; NaN stays."""
        found = np.array(heights, dtype=np.float64)
        if self._has_radii:
            latitudes = self._place.to_lonlat(np.column_stack([x, y]))[:, 1]
            return self._place.ellipsoid.heights_of_radii(latitudes, found)
        known = np.isfinite(found)
        if self._transformer is None or not known.any():
            return found
        found[known] = self._moved(x[known], y[known], found[known])
        if not np.isfinite(found[known]).all():
            grids = ", ".join(self.grids) or self.description
            raise InvalidHeightsError(
                f"some heights have no place above the ellipsoid: {grids} does not cover all of the"
                " raster; expected a part that it covers, or `vertical` as-is"
            )
        return found

    def raised(self, x: Numbers, y: Numbers, heights: Numbers) -> Numbers:
        """Return the increase of `heights` at points; NaN outside of the grid."""
        if self._transformer is None:
            return np.zeros(heights.shape)
        raised = self._moved(x, y, heights) - heights
        return raised if np.isfinite(raised).any() else np.zeros(heights.shape)

    def _moved(self, x: Numbers, y: Numbers, heights: Numbers) -> Numbers:
        places = np.column_stack([x, y, heights / self._metres])
        axis = self._place.longitude_axis
        if axis is not None and self._place.kind == GEOGRAPHIC:
            turn = 360 / self._place.unit
            places[:, axis] = np.mod(places[:, axis] + turn / 2, turn) - turn / 2
        new: Numbers = moved(self._transformer, places)[:, 2]
        return new

    def describe(self) -> dict[str, Any]:
        about: dict[str, Any] = {"heights": ELLIPSOID}
        if self.description:
            about |= {"operation": self.description, "grids": list(self.grids)}
        return about

    @property
    def words(self) -> str:
        if not self.description:
            return "heights are above the ellipsoid already"
        if self.description == RADII:
            return f"heights are above the ellipsoid, {RADII}"
        grids = f" with {', '.join(self.grids)}" if self.grids else ""
        return f"heights are above the ellipsoid, by PROJ's “{self.description}”{grids}"


def radii_on_own_datum(place: Place) -> EllipsoidalHeights:
    if place.system is None:
        raise InvalidHeightsError(
            "the raster has no coordinate reference system, so that nothing tells the radius of its"
            " body; expected one, or `vertical` as-is"
        )
    target = place.system.flat.to_3d().to_wkt()
    return EllipsoidalHeights(RADII, (), target, None, place, 1.0, True)


def on_own_datum(
    place: Place, bounds: tuple[float, float, float, float], target: str | None = None
) -> EllipsoidalHeights:
    """Return the conversion to heights above the ellipsoid of the raster's own CRS, or a target's.

    PROJ chooses the operation by the raster's bounds (left, bottom, right, top). Raise if the CRS
    has no vertical system, or PROJ has no operation or lacks files for it.
    """
    told = vertical_of(place.system.text if place.system is not None else None)
    if told is None or place.system is None:
        raise InvalidHeightsError(
            "the raster's coordinate reference system names no vertical datum, so that nothing"
            " tells how far the ellipsoid is from it; expected a compound one, such as"
            " EPSG:4326+5773 for EGM96, or `vertical` as-is"
        )
    system = place.system
    if told.is_ellipsoidal:
        return EllipsoidalHeights("", (), system.known.to_wkt(), None, place, 1.0)
    goal = system.flat.to_3d() if target is None else need_pyproj().CRS.from_user_input(target)
    if system.body != THE_EARTH and target is not None:
        goal = system.globe.to_3d()
    operation = _best_operation(system, goal, _area(place, bounds), told)
    pyproj = need_pyproj()
    return EllipsoidalHeights(
        _NO_CHANGE.sub("", operation.description),
        tuple(dict.fromkeys(_GRIDS.findall(operation.definition))),
        goal.to_wkt(),
        pyproj.Transformer.from_pipeline(operation.definition),
        place,
        -told.metres if told.is_down else told.metres,
    )


# Onto the ellipsoid of WGS 84.
onto_wgs84 = partial(on_own_datum, target=_WGS_84)


def _area(place: Place, bounds: tuple[float, float, float, float]) -> Any:
    left, bottom, right, top = bounds
    x, y = np.meshgrid(np.linspace(left, right, _N_ALONG), np.linspace(bottom, top, _N_ALONG))
    lonlat = place.to_lonlat(np.column_stack([x.ravel(), y.ravel()]))
    lonlat = lonlat[np.isfinite(lonlat).all(axis=1)]
    if not len(lonlat):
        raise InvalidHeightsError("the raster has no place in longitude and latitude")
    middle = lonlat[len(lonlat) // 2, 0]
    lon = middle + np.mod(lonlat[:, 0] - middle + 180, 360) - 180
    west, east = (float((end + 180) % 360 - 180) for end in (lon.min(), lon.max()))
    south, north = float(lonlat[:, 1].min()), float(lonlat[:, 1].max())
    aoi = need_pyproj().aoi.AreaOfInterest
    return aoi(west, max(south, -90.0), east, min(north, 90.0))


def _best_operation(system: System, goal: Any, area: Any, told: Vertical) -> Any:
    """Return PROJ's first operation that changes heights, if all of its grids are installed."""
    pyproj = need_pyproj()
    _look_where_proj_data_says()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # pyproj's, reported below
        try:
            found = pyproj.transformer.TransformerGroup(
                system.known, goal, always_xy=True, area_of_interest=area, allow_ballpark=False
            )
        except pyproj.exceptions.ProjError as error:
            raise InvalidHeightsError(f"PROJ cannot convert the heights: {error}") from error
    if found.best_available and found.transformers:
        return found.transformers[0]
    if not found.unavailable_operations:
        raise InvalidHeightsError(
            f"PROJ knows no operation from {told.name} to the ellipsoid at this place, other than"
            " ballpark ones, which leave heights as they are; expected another vertical system in"
            " the coordinate reference system, or `vertical` as-is"
        )
    best = found.unavailable_operations[0]
    missing = [grid for grid in best.grids if not grid.available]
    names = [grid.short_name for grid in missing]
    known = [grid.short_name for grid in missing if grid.url]
    how = (
        f"get {'it' if len(known) == 1 else 'them'} with"
        f" {' && '.join(f'pyproj sync --file {name}' for name in known[:_MOST_NAMED])}"
        if len(known) == len(names)
        else f"PROJ says no source; copy {'it' if len(names) == 1 else 'them'}"
        f" into {pyproj.datadir.get_user_data_dir()}"
    )
    raise InvalidHeightsError(
        f"heights above {_reference(told)} need PROJ's {', '.join(names)} to become ellipsoidal"
        f" (“{best.name}”), not found; {how}, or take `vertical` as-is"
    )


def _look_where_proj_data_says() -> None:
    """Make pyproj search PROJ_DATA's directories after its own; its wheels do not."""
    datadir = need_pyproj().datadir
    own = datadir.get_data_dir().split(os.pathsep)
    for folder in os.environ.get("PROJ_DATA", "").split(os.pathsep):
        if folder and folder not in own and os.path.isdir(folder):
            datadir.append_data_dir(folder)
