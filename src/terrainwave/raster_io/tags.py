"""Tags of rasters: those that a file keeps, and those that an output gets."""

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from terrainwave.raster_io.raster_info import Tags

# Limit in UTF-8 bytes of the names and values of one set: files open with one short read.
_MOST_BYTES = 16 << 10
# Usual colours of bands; an alpha or a palette would have another meaning in the output.
PLAIN_COLORS = ("gray", "undefined", "alpha", "palette")
# A domain that GDAL's commands do not copy. They copy plain tags to rasters that were resampled or
# computed, for which a bound does not hold.
DOMAIN = "TERRAINWAVE"
# Stored in a field of its own; statistics were computed before heights were rounded.
_OWN = "AREA_OR_POINT"
_MEASURED = "STATISTICS_"
# Names that rasterio's `update_tags` uses for its own arguments.
_RESERVED = ("ns", "bidx")


class KeptTags(NamedTuple):
    """Kept tags, and the names of those that are too long or not text."""

    kept: Tags
    left_out: tuple[str, ...]


def select_tags(tags: Mapping[str, str]) -> KeptTags:
    sizes = {name: _size(name) + _size(value) for name, value in writable_tags(tags.items())}
    kept, room = [], _MOST_BYTES
    for name in sorted(sizes, key=lambda name: (sizes[name], name)):
        if sizes[name] <= room:
            room -= sizes[name]
            kept.append((name, tags[name]))
    names = {name for name, _ in kept}
    left_out = (name for name in tags if name not in names and not _is_own(name))
    return KeptTags(tuple(sorted(kept)), tuple(left_out))


def common_tags(sets: Iterable[Tags]) -> Tags:
    first, *others = map(set, sets)
    return tuple(sorted(first.intersection(*others)))


def writable_tags(tags: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Yield the tags that GDAL can write; those of an untrusted file may be any text."""
    for name, value in tags:
        is_text = all(_size(text) >= 0 and "\0" not in text for text in (name, value))
        if name and "=" not in name and name not in _RESERVED and is_text and not _is_own(name):
            yield name, value


def is_statistic(name: str) -> bool:
    return name.upper().startswith(_MEASURED)


def _is_own(name: str) -> bool:
    return name.upper() == _OWN or is_statistic(name)


def _size(text: str) -> int:
    """Return the UTF-8 bytes of a text; -1 if it is not text."""
    try:
        return len(text.encode())
    except UnicodeEncodeError:
        return -1
