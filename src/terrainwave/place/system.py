"""A coordinate reference system that transforms, with pyproj; created once for each text."""

import contextlib
import re
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError
from terrainwave.extras import need
from terrainwave.place.bodies import EARTH as THE_EARTH
from terrainwave.place.bodies import body_of
from terrainwave.place.description import Description, describe_crs
from terrainwave.place.ellipsoid import EARTH, Ellipsoid

_CODE = re.compile(r"([A-Za-z][A-Za-z0-9_]*):([A-Za-z0-9_.]+)")
# Longitude and latitude of WGS 84, in that order.
_WGS_84 = "OGC:CRS84"
_CACHED = 64
_LONGITUDE_LATITUDE = {
    "subtype": "ellipsoidal",
    "axis": [
        {"name": "Longitude", "abbreviation": "lon", "direction": "east", "unit": "degree"},
        {"name": "Latitude", "abbreviation": "lat", "direction": "north", "unit": "degree"},
    ],
}


def need_pyproj(*, extra: str = "mesh", purpose: str = "a coordinate reference system") -> Any:
    need("pyproj.exceptions", extra=extra, purpose=purpose)
    return need("pyproj", extra=extra, purpose=purpose)


class System:
    """A CRS: its description, ellipsoid and body, and conversion to longitude and latitude."""

    def __init__(self, crs_text: str, description: Description) -> None:
        self.text = crs_text
        self.description = description
        self.known = _known_to_pyproj(crs_text)
        self.ellipsoid = _ellipsoid_of(self.known)
        self.body = body_of(description, self.ellipsoid)

    @cached_property
    def flat(self) -> Any:
        known = self.known
        if known.is_compound:
            known = known.sub_crs_list[0]
        known = known if len(known.axis_info) < 3 else known.to_2d()
        told = known.to_json_dict()
        axes = told.get("coordinate_system", {})
        if axes.get("subtype") != "spherical":
            return known
        # PROJ puts longitudes first on request, but not with planetocentric latitudes.
        axes["axis"].sort(key=lambda axis: axis["direction"] in ("north", "south"))
        return need_pyproj().CRS.from_json_dict(told)

    @cached_property
    def globe(self) -> Any:
        """Return pyproj's CRS of degrees on the body: WGS 84 for the Earth, else its datum."""
        pyproj = need_pyproj()
        base = None if self.known is None else self.known.geodetic_crs
        if base is None or self.known.is_geocentric:
            raise InvalidHeightsError(
                "the coordinate reference system has no longitudes and latitudes behind it"
            )
        if self.body == THE_EARTH:
            return pyproj.CRS.from_user_input(_WGS_84)
        told = base.to_2d().to_json_dict()
        while "base_crs" in told:
            told = told["base_crs"]
        datum = {key: told[key] for key in ("datum", "datum_ensemble") if key in told}
        name = {"type": "GeographicCRS", "name": told.get("name", "unnamed")}
        return pyproj.CRS.from_json_dict(name | datum | {"coordinate_system": _LONGITUDE_LATITUDE})

    @cached_property
    def _to_globe(self) -> Any:
        return self._transformer(self.flat, self.globe)

    @cached_property
    def _from_globe(self) -> Any:
        return self._transformer(self.globe, self.flat)

    def _transformer(self, source: Any, target: Any) -> Any:
        pyproj = need_pyproj()
        try:
            return pyproj.Transformer.from_crs(source, target, always_xy=True)
        except pyproj.exceptions.ProjError as error:
            raise InvalidHeightsError(
                f"PROJ has no way from the raster's coordinates to longitude and latitude: {error}"
            ) from error

    def to_globe(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return moved(self._to_globe, xy)

    def from_globe(self, lonlat: NDArray[np.float64]) -> NDArray[np.float64]:
        return moved(self._from_globe, lonlat)


def moved(transformer: Any, points: NDArray[np.float64]) -> NDArray[np.float64]:
    if not len(points):
        return points
    # Libraries rely on numpy's default settings, which callers may have changed.
    with np.errstate(all="ignore"):
        found = np.column_stack(transformer.transform(*points.T, errcheck=False))
    found[~np.isfinite(found).all(axis=1)] = np.nan
    return found


def system_of(crs_text: str | None) -> System | None:
    description = describe_crs(crs_text)
    if crs_text is None or description is None:
        return None
    need_pyproj()
    return _made(crs_text)


@lru_cache(_CACHED)
def _made(crs_text: str) -> System:
    description = describe_crs(crs_text)
    assert description is not None
    return System(crs_text, description)


def _known_to_pyproj(crs_text: str) -> Any:
    """Return pyproj's CRS of a text, which has more codes than GDAL's WKT; None if unknown."""
    pyproj = need_pyproj()
    code = _CODE.fullmatch(crs_text)
    with contextlib.suppress(pyproj.exceptions.CRSError):
        if code:
            return pyproj.CRS.from_authority(*code.groups())
        return pyproj.CRS.from_wkt(crs_text)
    from rasterio.errors import CRSError

    from terrainwave.place.crs import parse_crs

    crs: Any = parse_crs(crs_text)
    for version in ("WKT2_2019", "WKT1_GDAL"):
        with contextlib.suppress(CRSError, pyproj.exceptions.CRSError, AttributeError):
            return pyproj.CRS.from_wkt(crs.to_wkt(version=version))
    return None


def _ellipsoid_of(known: Any) -> Ellipsoid:
    ellipsoid = None if known is None else known.ellipsoid
    if ellipsoid is None or not ellipsoid.semi_major_metre > 0:
        return EARTH
    inverse = ellipsoid.inverse_flattening  # 0: a sphere
    flattening = 1 / inverse if inverse > 1 else 0.0
    return Ellipsoid(ellipsoid.semi_major_metre, flattening * (2 - flattening))
