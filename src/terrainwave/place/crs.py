"""Coordinate reference systems as short text and back."""

import contextlib
import re
import warnings
from typing import Any

import rasterio
from rasterio.crs import CRS
from rasterio.errors import CRSError

from terrainwave.errors import TerrainwaveWarning

_AUTHORITY_CODE = re.compile(r"([A-Za-z][A-Za-z0-9_]*):([A-Za-z0-9_.]+)")
_WKT_START = re.compile(r"\s*[A-Z][A-Z0-9_]*\s*[\[(]")


def parse_crs(text: str | None) -> CRS | None:
    """Return the CRS that ``"AUTH:CODE"`` or WKT stands for; warn and return None if none does.

    Nothing else is understood, as the text may come from an untrusted file: given a URL or a path
    instead, GDAL would fetch it.
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
    """Return the CRS of a CF grid mapping that holds no WKT.

    Raises
    ------
    ImportError
        Without pyproj.
    CRSError, KeyError, RuntimeError, TypeError, ValueError
        If it does not understand the mapping.
    """
    from pyproj import CRS as ProjCRS

    return CRS.from_wkt(ProjCRS.from_cf(mapping).to_wkt())


def format_crs(crs: CRS | None) -> str | None:
    """Return ``"AUTH:CODE"`` where that code means exactly `crs`, else its WKT; None for none.

    Equal means: the same WKT. Looser comparisons (PROJ's, rasterio's ``==``) call two systems the
    same whose ellipsoids differ in the ninth digit. The WKT compared is rasterio's default, as
    GeoTIFF keys don't carry the areas and ensembles that the registry's WKT2 has.
    """
    if not crs:
        return None
    authority = crs.to_authority()
    if authority is not None:
        with contextlib.suppress(CRSError):
            if CRS.from_authority(*authority).to_wkt() == crs.to_wkt():
                return ":".join(authority)
    # WKT2 as GDAL writes it drops the codes of inner parts that WKT1 keeps, and WKT1 cannot say
    # everything: take the first that gives the same system back.
    candidates = []
    for version in ("WKT2_2019", "WKT1_GDAL"):
        with contextlib.suppress(CRSError):
            candidates.append(str(crs.to_wkt(version=version)))
            if CRS.from_wkt(candidates[-1]).to_wkt() == crs.to_wkt():
                return candidates[-1]
    return candidates[0] if candidates else str(crs.to_wkt())


def is_exact(crs: CRS | None) -> bool:
    """Tell whether `format_crs` gives text from which the same system comes back."""
    if not crs:
        return True
    text = format_crs(crs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        back = parse_crs(text)
    return back is not None and back.to_wkt() == crs.to_wkt()
