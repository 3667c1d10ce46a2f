"""The JSON metadata of a file (FORMAT.md §4.2)."""

import json
import math
import re
from collections.abc import Iterator
from typing import NoReturn, cast

from terrainwave.annexes import read_annex
from terrainwave.coding.deflate import deflate, inflate
from terrainwave.container.header import MAX_METADATA
from terrainwave.errors import CorruptStreamError, InvalidHeightsError, TerrainwaveError

# Origin of a file, by which `compress` recognises it; not needed for decoding.
ORIGIN = "origin"
# The .twz files that the heights went through before, each with its bound.
EARLIER = "earlier"

MAX_NESTING = 16
MAX_MOVED = 1 << 31

_STRINGS = ("crs", "mask_kind", "units", "description", "software", "color_interpretation")
_TEXTS_BY_NAME = ("tags", "band_tags")
_NUMBERS = ("scale", "offset")
# A string, or one bracket outside of strings.
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[\[\]{}]', re.DOTALL)


def pack_metadata(metadata: dict[str, object]) -> bytes:
    try:
        text = json.dumps(
            metadata, sort_keys=True, ensure_ascii=False, allow_nan=False, separators=(",", ":")
        ).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise InvalidHeightsError(f"metadata cannot be stored: {error}") from None
    if len(text) > MAX_METADATA:
        raise InvalidHeightsError(f"metadata of {len(text)} bytes, more than 1 MiB")
    packed = deflate(text, read_annex("dictionary.txt"))
    if len(packed) > MAX_METADATA:
        raise InvalidHeightsError("metadata is more than 1 MiB")
    try:
        unpack_metadata(packed)
    except TerrainwaveError as error:
        raise InvalidHeightsError(f"metadata cannot be stored: {error}") from None
    return packed


def unpack_metadata(packed: bytes) -> dict[str, object]:
    data = inflate(packed, MAX_METADATA, "metadata", read_annex("dictionary.txt"))
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise CorruptStreamError(f"metadata is not UTF-8: {error}") from None
    # Before json parses it: its parser recurses to a depth that depends on the Python version.
    if _nesting(text) > MAX_NESTING:
        raise CorruptStreamError(f"metadata is nested deeper than {MAX_NESTING}")
    try:
        metadata = json.loads(
            text,
            object_pairs_hook=_unique_keys,
            parse_float=_finite,
            parse_int=_whole,
            parse_constant=_no_constant,
        )
        # A lone surrogate escape is legal JSON but not text: printing it would fail.
        json.dumps(metadata, ensure_ascii=False).encode("utf-8")
    except ValueError as error:
        raise CorruptStreamError(f"metadata is not the JSON expected: {error}") from None
    if not isinstance(metadata, dict):
        raise CorruptStreamError("metadata is not a JSON object")
    for problem in _wrong_values(metadata):
        raise CorruptStreamError(f"metadata: {problem}")
    return metadata


def without_origin(metadata: dict[str, object]) -> dict[str, object]:
    """Return the metadata of a file that `compress` would no longer make."""
    return {key: value for key, value in metadata.items() if key != ORIGIN}


def _nesting(text: str) -> int:
    depth = deepest = 0
    for match in _TOKEN.finditer(text):
        if match[0] in "[{":
            depth += 1
            deepest = max(deepest, depth)
        elif match[0] in "]}":
            depth -= 1
    return deepest


def _unique_keys(pairs: list[tuple[str, object]]) -> dict[str, object]:
    result = dict(pairs)
    if len(result) < len(pairs):
        raise ValueError("a key occurs twice")
    return result


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"number {text[:20]} is too large")
    return value


def _whole(text: str) -> int:
    _finite(text)  # before `int`, whose time grows with the square of the digits
    return int(text)


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a JSON number")


def _wrong_values(metadata: dict[str, object]) -> Iterator[str]:
    for key in _STRINGS:
        if not isinstance(metadata.get(key), str | None):
            yield f"{key} is not a string"
    for key in _NUMBERS:
        if metadata.get(key) is not None and not _is_number(metadata[key]):
            yield f"{key} is not a number"
    for key in _TEXTS_BY_NAME:
        texts = metadata.get(key)
        if texts is not None and not (
            isinstance(texts, dict) and all(isinstance(text, str) for text in texts.values())
        ):
            yield f"{key} is not an object of strings"
    moved = metadata.get("moved")
    is_whole = _is_number(moved) and float(cast(float, moved)).is_integer()
    if moved is not None and not (is_whole and 0 <= cast(float, moved) <= MAX_MOVED):
        yield "moved is not a whole number of quanta from 0 to 2^31"
    if metadata.get("scale") == 0:
        yield "scale is 0"
    transform = metadata.get("transform")
    if transform is not None and not (
        isinstance(transform, list) and len(transform) == 6 and all(map(_is_number, transform))
    ):
        yield "transform is not a list of six numbers"
    nodata = metadata.get("nodata")
    if nodata not in (None, "nan", "inf", "-inf") and not _is_number(nodata):
        yield 'nodata is neither a number nor null, "nan", "inf" or "-inf"'
    if metadata.get("area_or_point") not in (None, "Area", "Point"):
        yield "area_or_point is neither Area nor Point"


def _is_number(value: object) -> bool:
    # 2^64: an int this small converts to a float without overflow in any reader.
    if isinstance(value, bool):
        return False
    return isinstance(value, float) or (isinstance(value, int) and abs(value) <= 2**64)
