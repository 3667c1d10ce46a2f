"""Bytes that are made when they are asked for: in bounded numbers of threads, before they are sent.

While one part of an answer is sent the next one is made; and where a client reads on from where it
stopped, as GDAL does through a whole raster, so is what it will ask for next.
"""

import asyncio
import re
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import aclosing, suppress
from functools import partial
from typing import Any, NamedTuple, Self

from fastapi import HTTPException

from terrainwave.errors import TerrainwaveError

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


# Requests that wait for their turn: some seconds of work, after which a client would have given up.
N_WAITING = 64
PART = 1 << 20
# Bytes that are made before they are asked for: as many as GDAL asks for at once.
_AHEAD = 4 << 20

Read = Callable[[int, int], bytes]


class Desk:
    """Lets `n_decoding` requests decode, or read, at a time; a context manager."""

    def __init__(self, n_decoding: int) -> None:
        # Threads of their own: what one keeps to compute with, such as PROJ's, none other keeps.
        self._threads = ThreadPoolExecutor(n_decoding, thread_name_prefix="decoding")
        self._n_decoding = n_decoding
        self._n_asked = 0

    async def do(self, work: Callable[..., Any], *args: Any, is_begun: bool = False) -> Any:
        """Return ``work(*args)`` of a thread; 503 if too many wait, unless the answer has begun."""
        if not is_begun and self._n_asked >= self._n_decoding + N_WAITING:
            raise HTTPException(503, "too many requests at once", {"Retry-After": "1"})
        self._n_asked += 1
        try:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._threads, partial(work, *args))
        finally:
            self._n_asked -= 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._threads.shutdown(cancel_futures=True)

    @property
    def is_free(self) -> bool:
        """Say whether work that is begun now is begun at once."""
        return self._n_asked < self._n_decoding


class Ahead:
    """Has bytes made before they are asked for, where a client reads on; for one resource."""

    def __init__(self, read: Read) -> None:
        self._read = read
        self._stop = -1
        self._task: asyncio.Task[None] | None = None

    def note(self, desk: Desk, span: Span) -> None:
        """Go on behind a span that is nearly sent if the client reads on, or asks for long ones."""
        is_read_on = span.start == self._stop or span.stop - span.start >= _AHEAD
        self._stop = span.stop
        if is_read_on and (self._task is None or self._task.done()):
            self._task = asyncio.create_task(self._go_on(desk, span.stop, span.size))

    async def _go_on(self, desk: Desk, start: int, size: int) -> None:
        for place in range(start, min(start + _AHEAD, size), PART):
            if not desk.is_free:
                return
            # Whoever asks for it is told.
            with suppress(TerrainwaveError):
                await desk.do(self._read, place, min(PART, size - place))


async def parts(
    desk: Desk, read: Read, span: Span, ahead: Ahead | None
) -> AsyncGenerator[bytes, None]:
    """Yield the bytes of a span in parts; once the first has come, the others wait."""
    n_bytes = span.stop - span.start
    making = asyncio.ensure_future(desk.do(read, span.start, min(PART, n_bytes)))
    try:
        for start in range(span.start + PART, span.stop, PART):
            made = await making
            n_next = min(PART, span.stop - start)
            making = asyncio.ensure_future(desk.do(read, start, n_next, is_begun=True))
            yield made
        made = await making
        if ahead is not None:
            ahead.note(desk, span)
        yield made
    finally:
        making.cancel()


async def begun(made: AsyncGenerator[bytes, None]) -> AsyncIterator[bytes]:
    """Return the same parts; the first is made now, so that its errors become answers."""
    first = await anext(made)

    async def all_parts() -> AsyncIterator[bytes]:
        async with aclosing(made):
            yield first
            async for part in made:
                yield part

    return all_parts()
