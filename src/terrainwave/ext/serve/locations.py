"""Places that a request for heights names, as Open-Elevation and OpenTopoData take them."""

import asyncio
import json
import math
import re
from collections.abc import AsyncIterator
from typing import Any, NamedTuple
from urllib.parse import parse_qs

import numpy as np
from fastapi import HTTPException
from numpy.typing import NDArray

from terrainwave.arguments import shown
from terrainwave.ext.serve import client_limits

# Places of one request: some tenths of a second where each lies in a block of its own.
MAX_PLACES = 10_000
# Bytes of a request's body: more than MAX_PLACES take with 15 decimals.
MAX_BODY = 1 << 20
# Longitudes may be of another turn.
_MOST_LON, _MOST_LAT = 720, 90
_EXPECTED = "expected locations=lat,lon|lat,lon"
_PAIR = re.compile(r"\s*([-+.\deE]{1,40})\s*,\s*([-+.\deE]{1,40})\s*", re.ASCII)


class BadLocationsError(Exception):
    """A request names no places; the message is one line."""


class Locations(NamedTuple):
    """Places in degrees, float64."""

    lon: NDArray[np.float64]
    lat: NDArray[np.float64]


def locations_of(asked: Any, interpolation: Any = None) -> Locations:
    if interpolation not in (None, "bilinear"):
        raise BadLocationsError(f"found interpolation {shown(interpolation)}, expected bilinear")
    parts = asked.split("|") if isinstance(asked, str) else asked
    if not asked or not isinstance(parts, list):
        raise BadLocationsError(f"found no locations, {_EXPECTED}")
    if len(parts) > MAX_PLACES:
        raise BadLocationsError(
            f"found {len(parts):,} locations, expected at most {MAX_PLACES:,}: ask in several"
            " requests"
        )
    pairs = [_pair_of(part, number) for number, part in enumerate(parts, 1)]
    lat, lon = np.array(pairs, dtype=np.float64).T
    return Locations(lon, lat)


def _pair_of(part: Any, number: int) -> tuple[float, float]:
    if isinstance(part, dict):
        pair = part.get("latitude"), part.get("longitude")
    elif isinstance(part, str) and (match := _PAIR.fullmatch(part)):
        pair = match[1], match[2]
    else:
        raise BadLocationsError(
            f"found location {number} {shown(part)}, expected lat,lon, or in JSON an object with"
            " latitude and longitude"
        )
    lat = _degrees("latitude", pair[0], _MOST_LAT, number)
    return lat, _degrees("longitude", pair[1], _MOST_LON, number)


def _degrees(name: str, value: Any, most: int, number: int) -> float:
    try:
        degrees = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        degrees = math.nan
    if not -most <= degrees <= most:
        raise BadLocationsError(
            f"found {name} {shown(value)} of location {number}, expected -{most} … {most} degrees"
        )
    return degrees


async def read_body(stream: AsyncIterator[bytes]) -> bytes:
    body = bytearray()
    try:
        async with asyncio.timeout(client_limits.ASK_SECONDS):
            async for part in stream:
                body += part
                if len(body) > MAX_BODY:
                    raise HTTPException(413, f"found a longer body, expected {MAX_BODY:,} bytes")
    except TimeoutError:
        raise HTTPException(
            408, f"the body took more than {client_limits.ASK_SECONDS} seconds"
        ) from None
    return bytes(body)


def fields_of(body: bytes, media_type: str) -> dict[str, Any]:
    try:
        if media_type.split(";")[0].strip().lower() == "application/x-www-form-urlencoded":
            return {name: values[-1] for name, values in parse_qs(body.decode()).items()}
        found = json.loads(body)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise BadLocationsError(
            'found a body without a JSON object, expected {"locations": [{"latitude": …,'
            ' "longitude": …}]}'
        )
    return found
