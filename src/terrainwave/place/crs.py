"""Coordinate reference systems as short text and back."""

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


class _Said(NamedTuple):
    """What a file says of a CRS, and whether the same system comes back from it."""

    text: str
    is_exact: bool


def format_crs(crs: CRS | None) -> str | None:
    """Return ``"AUTH:CODE"`` where that code means exactly `crs`, else its WKT; None for none.

    Equal means: the same WKT. Looser comparisons (PROJ's, rasterio's ``==``) call two systems the
    same whose ellipsoids differ in the ninth digit. The WKT compared is rasterio's default, as
    GeoTIFF keys don't carry the areas and ensembles that the registry's WKT2 has.
    """
    return _said_of(crs).text if crs else None


def is_exact(crs: CRS | None) -> bool:
    """Tell whether `format_crs` gives text from which the same system comes back."""
    return _said_of(crs).is_exact if crs else True


def _said_of(crs: CRS) -> _Said:
    """Return what is said of a CRS; PROJ is asked once about each, which takes milliseconds."""
    return _SAID.get_or_make(_texts_of(crs), lambda: _say(crs))


def _texts_of(crs: CRS) -> tuple[str, ...]:
    """Return WKT of a CRS that together says all of it.

    Not WKT1 by name: where it cannot hold a system, GDAL's error meets the next call of rasterio.
    """
    texts = [str(crs.to_wkt())]
    with contextlib.suppress(CRSError):
        texts.append(str(crs.to_wkt(version=_WKT_VERSIONS[0])))
    return tuple(texts)


def _say(crs: CRS) -> _Said:
    authority, own = crs.to_authority(), crs.to_wkt()
    if authority is not None:
        with contextlib.suppress(CRSError):
            if CRS.from_authority(*authority).to_wkt() == own:
                return _Said(":".join(authority), True)
    # WKT2 as GDAL writes it drops the codes of inner parts that WKT1 keeps, and WKT1 cannot say
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


# By the texts of a CRS.
_SAID: Cache[tuple[str, ...], _Said] = Cache(64)
