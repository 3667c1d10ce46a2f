"""Connections of `terrainwave serve`: how many there may be, and how long a client may take.

uvicorn waits without end for a client that sends half a request, sends none, or does not take its
answer, and its ``limit_concurrency`` counts a connection only once a request has come. So each one
is looked at every second here.
"""

import asyncio
import logging
import os
import socket
import struct
from contextlib import suppress
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from terrainwave import interrupts
from terrainwave.arguments import in_one_line
from terrainwave.errors import TerrainwaveError
from terrainwave.ext.serve.log import warn_once

try:
    import resource
except ImportError:  # Windows, which has no such limit
    resource = None  # type: ignore[assignment]

# Some hundred clients of a few connections each; below the 1024 handles that most systems give a
# process. Each may hold an answer of `sending.PART` bytes and the next one.
MAX_CONNECTIONS = 384
# Handles that the files, the event loop and what is read for the page may take.
_OTHER_HANDLES = 64
# Of a request that comes bit by bit. Browsers send some 2 kB.
_MOST_REQUEST_BYTES = 16 << 10
# Seconds for the rest of a request, its line and headers: they come in one piece or two.
ASK_SECONDS = 10
# Seconds for the part of an answer that was handed to the system, 1 MiB at most: 17 kB/s.
TAKE_SECONDS = 60
# Seconds for the next request: a page asks again at once, and whoever comes later connects again.
IDLE_SECONDS = 5
_GRACE_SECONDS = 2
_LOOK_SECONDS = 1.0
# struct linger of two ints, on Windows of two shorts: on, for no second.
_NO_LINGER = struct.pack("hh" if os.name == "nt" else "ii", 1, 0)

_FULL = (
    b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 1\r\nContent-Length: 0\r\n"
    b"Connection: close\r\n\r\n"
)


class Connection(H11Protocol):
    """One connection, ended where its client is slow, or at once where there are too many."""

    max_connections = MAX_CONNECTIONS

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._n_taken = 0
        self._stage: Any = None
        self._since = self.loop.time()
        self._look = self.loop.call_later(_LOOK_SECONDS, self._look_at)
        if len(self.connections) > self.max_connections:
            transport.write(_FULL)
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        self._look.cancel()
        super().connection_lost(exc)

    def resume_writing(self) -> None:
        """Count the times that a client has taken what there was."""
        self._n_taken += 1
        super().resume_writing()

    def _look_at(self) -> None:
        """End the connection if the client has been doing the same thing for too long."""
        stage: tuple[float, object] | None = None
        if self.transport.get_write_buffer_size():
            stage = TAKE_SECONDS, self._n_taken
        elif self.cycle is None or self.cycle.response_complete:
            stage = ASK_SECONDS, self.cycle
        now = self.loop.time()
        if stage != self._stage:
            self._stage, self._since = stage, now
        elif stage is not None and now - self._since >= stage[0]:
            self._drop()
            return
        self._look = self.loop.call_later(_LOOK_SECONDS, self._look_at)

    def _drop(self) -> None:
        """End the connection now, and what the system holds to be sent: some MB otherwise."""
        handle = self.transport.get_extra_info("socket")
        with suppress(OSError):
            handle.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
        self.transport.abort()


def server_of(app: ASGIApp, n_files: int = 0) -> uvicorn.Server:
    config = uvicorn.Config(
        app,
        # Not httptools, where that is installed: its protocol is another class.
        http=_limited(n_files),
        ws="none",
        log_level="warning",
        server_header=False,
        # `proxies` has what this would do, and only that.
        proxy_headers=False,
        h11_max_incomplete_event_size=_MOST_REQUEST_BYTES,
        timeout_keep_alive=IDLE_SECONDS,
        timeout_graceful_shutdown=_GRACE_SECONDS,
    )
    logging.getLogger("uvicorn.error").addFilter(_is_logged)
    return _Server(config)


class _Server(uvicorn.Server):
    """A server that also ends by signals that uvicorn does not handle, such as SIGHUP."""

    async def on_tick(self, counter: int) -> bool:
        return await super().on_tick(counter) or interrupts.is_requested()


def _limited(n_files: int) -> type[Connection]:
    most = MAX_CONNECTIONS
    if resource is not None:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = MAX_CONNECTIONS + n_files + _OTHER_HANDLES
        if soft != resource.RLIM_INFINITY and soft < wanted:
            soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
            most = max(1, soft - n_files - _OTHER_HANDLES)
    return type("Connection", (Connection,), {"max_connections": most})


def _is_logged(record: logging.LogRecord) -> bool:
    """Return false for lines that any client can cause, such as a malformed request.

    Once an answer has begun, an error can only end the connection, and uvicorn logs it as a fault.
    If a file is to blame, that becomes a line without a traceback.
    """
    error: BaseException | None = record.exc_info[1] if record.exc_info else None
    while error is not None and not isinstance(error, TerrainwaveError):
        error = error.__cause__
    if error is not None:
        warn_once(f"an answer ended early: {in_one_line(error)}")
    return error is None and record.levelno >= logging.ERROR
