"""One byte range of a resource (RFC 9110, section 14), as GDAL and geotiff.js ask for them."""

import re
from collections.abc import Mapping
from typing import NamedTuple

# Of more digits is no file; Python refuses to read some thousand of them.
_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


class Span(NamedTuple):
    """Bytes ``start`` … ``stop`` - 1 of `size`, and whether the client asked for a part."""

    start: int
    stop: int
    size: int
    is_part: bool

    @property
    def headers(self) -> dict[str, str]:
        headers = {"Accept-Ranges": "bytes", "Content-Length": str(self.stop - self.start)}
        if self.is_part:
            headers["Content-Range"] = f"bytes {self.start}-{self.stop - 1}/{self.size}"
        return headers


def asked_span(headers: Mapping[str, str], size: int, tag: str) -> Span | None:
    """Return the range that a request asks for, all for none or several; None if beyond the end."""
    whole = Span(0, size, size, is_part=False)
    match = _RANGE.fullmatch(headers.get("range", "").replace(" ", ""))
    if match is None or match[0] == "bytes=-" or headers.get("if-range", tag) != tag:
        return whole
    if not match[1]:
        start, stop = max(size - int(match[2]), 0), size
    else:
        start = int(match[1])
        stop = min(int(match[2]) + 1, size) if match[2] else size
        if match[2] and int(match[2]) < start:  # not a range
            return whole
    return Span(start, stop, size, is_part=True) if start < stop else None


def is_same(asked: str, tag: str) -> bool:
    """Say whether an If-None-Match header names the version `tag`, a proxy's weak one too."""
    names = (name.strip().removeprefix("W/") for name in asked.split(","))
    return any(name in ("*", tag) for name in names)
