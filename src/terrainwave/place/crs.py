"""Conversion of coordinate reference systems to short text and back."""

import contextlib
import re
import warnings
from typing import Any, NamedTuple

import rasterio
from rasterio.crs import CRS
from rasterio.errors import CRSError

from terrainwave.cache import Cache
from terrainwave.errors import TerrainwaveWarning

_AUTHORITY_CODE = re.compile(r"([A-Za-z][A-Za-z0-9_]*):([A-Za-z0-9_.]+)")
_WKT_VERSIONS = "WKT2_2019", "WKT1_GDAL"
_WKT_START = re.compile(r"\s*[A-Z][A-Z0-9_]*\s*[\[(]")


def parse_crs(text: str | None) -> CRS | None:
    """Return the CRS of ``"AUTH:CODE"`` or WKT; warn and return None if it is neither.

    Given a URL or a path from an untrusted file, GDAL would fetch it.
    """
    if text is None:
        return None
    code = _AUTHORITY_CODE.fullmatch(text)
    try:
        with rasterio.Env():
            if code:
                return CRS.from_authority(*code.groups())
            if _WKT_START.match(text):
                return CRS.from_wkt(text)
            raise CRSError("it is neither AUTHORITY:CODE nor WKT")
    except (CRSError, ValueError) as error:
        warnings.warn(
            f"the coordinate reference system is ignored, PROJ does not understand it: {error}",
            TerrainwaveWarning,
            stacklevel=2,
        )
        return None


def crs_of_grid_mapping(mapping: dict[str, Any]) -> CRS:
    """Return the CRS of a CF grid mapping without WKT; pyproj's errors if it cannot read it."""
    from pyproj import CRS as ProjCRS

    return CRS.from_wkt(ProjCRS.from_cf(mapping).to_wkt())


class _Said(NamedTuple):
    """Text of a CRS in a file, and whether it gives the same system back."""

    text: str
    is_exact: bool


def format_crs(crs: CRS | None) -> str | None:
    """Return ``"AUTH:CODE"`` if that code means exactly `crs`, else its WKT; None for None.

    Equal means: the same WKT. Looser comparisons (PROJ's, rasterio's ``==``) equate systems whose
    ellipsoids differ in the ninth digit. The WKT compared is rasterio's default, as GeoTIFF keys
    lack the areas and ensembles of the registry's WKT2.
    """
    return _said_of(crs).text if crs else None


def is_exact(crs: CRS | None) -> bool:
    return _said_of(crs).is_exact if crs else True


def _said_of(crs: CRS) -> _Said:
    """Return the text of a CRS; PROJ is asked only once about each, which takes milliseconds."""
    # Together they describe it completely. Not WKT1 by name: if it cannot represent a system,
    # GDAL's error appears at rasterio's next call.
    texts = [str(crs.to_wkt())]
    with contextlib.suppress(CRSError):
        texts.append(str(crs.to_wkt(version=_WKT_VERSIONS[0])))
    return _SAID.get_or_make(tuple(texts), lambda: _say(crs))


def _say(crs: CRS) -> _Said:
    authority, own = crs.to_authority(), crs.to_wkt()
    if authority is not None:
        with contextlib.suppress(CRSError):
            if CRS.from_authority(*authority).to_wkt() == own:
                return _Said(":".join(authority), True)
    # GDAL's WKT2 drops the codes of inner parts that WKT1 keeps, and WKT1 cannot express
    # everything: take the first that gives the same system back.
    candidates = []
    for version in _WKT_VERSIONS:
        with contextlib.suppress(CRSError):
            candidates.append(str(crs.to_wkt(version=version)))
            if CRS.from_wkt(candidates[-1]).to_wkt() == own:
                return _Said(candidates[-1], True)
    text = candidates[0] if candidates else str(own)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        back = parse_crs(text)
    return _Said(text, back is not None and back.to_wkt() == own)


_SAID: Cache[tuple[str, ...], _Said] = Cache(64)
