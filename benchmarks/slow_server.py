"""A local web server as slow as a distant one: ``with SlowServer(folder) as server: …``.

Each request waits for a round trip, and the first of a connection for one more, as TCP does; all
replies share one line. `is_down` cuts every connection and refuses new ones, as long as it is set.
"""

import contextlib
import math
import mimetypes
import os
import re
import socket
import threading
import time
from collections import namedtuple
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Self
from urllib.parse import unquote

_RANGE = re.compile(r"bytes=(\d+)-(\d+)")
# What a reply sends at a time, so that replies take turns on the line.
_CHUNK = 8192

# One request: start and end of its reply in seconds of `time.monotonic`, and what was asked for.
Exchange = namedtuple("Exchange", "start end n_bytes path user_agent")

# What some exchanges come to; those that overlap are one round: a client waited for them once.
Total = namedtuple("Total", "requests rounds n_bytes")


def total(log: Sequence[Exchange]) -> Total:
    """Return what exchanges come to: rounds are the most that begin one after the other's end."""
    n_rounds, last_end = 0, -math.inf
    for exchange in sorted(log, key=lambda exchange: exchange.end):
        if exchange.start >= last_end:
            n_rounds, last_end = n_rounds + 1, exchange.end
    return Total(len(log), n_rounds, sum(exchange.n_bytes for exchange in log))


def _type_of(name: str) -> str:
    """Return the media type of a file: browsers run nothing that is no JavaScript."""
    if name.endswith(".js"):
        return "text/javascript"
    return mimetypes.guess_type(name)[0] or "application/octet-stream"


class _Line:
    """A line of so many bits per second, which all replies share."""

    def __init__(self, bits_per_second: float) -> None:
        self._seconds_per_byte = 8 / bits_per_second
        self._lock = threading.Lock()
        self._free_at = 0.0

    def wait(self, n_bytes: int) -> None:
        """Return when so many bytes have passed."""
        with self._lock:
            start = max(time.monotonic(), self._free_at)
            end = self._free_at = start + n_bytes * self._seconds_per_byte
        time.sleep(max(end - time.monotonic(), 0.0))


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def setup(self) -> None:
        """Wait for the connection's own round trip."""
        super().setup()
        self.server.owner.connections.add(self.connection)
        time.sleep(self.server.owner.latency)

    def finish(self) -> None:
        """Forget the connection."""
        self.server.owner.connections.discard(self.connection)
        with contextlib.suppress(OSError):
            super().finish()

    def do_GET(self) -> None:
        """Answer a range of a file, or all of it, after the server's latency."""
        owner, start = self.server.owner, time.monotonic()
        time.sleep(owner.latency)
        name = unquote(self.path.partition("?")[0]).lstrip("/")
        try:
            with open(owner.folder / name, "rb") as file:
                size = os.fstat(file.fileno()).st_size
                match = _RANGE.fullmatch(self.headers.get("Range", ""))
                first, last = (int(match[1]), int(match[2])) if match else (0, size - 1)
                file.seek(first)
                body = file.read(max(last + 1 - first, 0))
        except OSError:
            body, match, size, first = None, None, 0, 0
        self.send_response(404 if body is None else 206 if match else 200)
        self.send_header("Content-Length", str(len(body or b"")))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Type", _type_of(name))
        self.send_header("ETag", f'"{size}"')
        if match:
            self.send_header("Content-Range", f"bytes {first}-{first + len(body) - 1}/{size}")
        self.end_headers()
        self._send(body if body and self.command == "GET" else b"", start)

    do_HEAD = do_GET  # GDAL asks first how long a file is

    def _send(self, body: bytes, start: float) -> None:
        """Send a body at the pace of the line; noted before its last bytes."""
        owner = self.server.owner
        for at in range(0, max(len(body), 1), _CHUNK):
            part = body[at : at + _CHUNK]
            owner.line.wait(len(part))
            if at + _CHUNK >= len(body):
                agent = self.headers.get("User-Agent", "")
                owner.log.append(Exchange(start, time.monotonic(), len(body), self.path, agent))
            self.wfile.write(part)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True
    request_queue_size = 64
    block_on_close = False

    def handle_error(self, *_: object) -> None:
        """Say nothing about clients that hang up."""


class SlowServer:
    """Serves the files of a folder over http, by ranges; a context manager.

    Parameters
    ----------
    folder : path
    latency : float
        Seconds of a round trip.
    bits_per_second : float
        Of the line, shared by all replies; infinity for none that counts.

    `log` has an `Exchange` per request, in the order in which they were answered.
    """

    def __init__(self, folder: Path, latency: float = 0.05, bits_per_second: float = 20e6) -> None:
        self.folder, self.latency = Path(folder), latency
        self.line = _Line(bits_per_second if bits_per_second else math.inf)
        self.log: list[Exchange] = []
        self.connections: set[socket.socket] = set()
        self._server: _Server | None = None
        self._port = 0

    @property
    def n_requests(self) -> int:
        """The requests answered so far."""
        return len(self.log)

    @property
    def n_bytes(self) -> int:
        """The bytes of all bodies sent so far."""
        return sum(exchange.n_bytes for exchange in list(self.log))

    def url(self, name: str) -> str:
        """Return the address of a file."""
        return f"http://127.0.0.1:{self._port}/{name}"

    @property
    def is_down(self) -> bool:
        """Whether connections are cut and refused; can be set."""
        return self._server is None

    @is_down.setter
    def is_down(self, value: bool) -> None:
        if value and self._server is not None:
            self._stop()
        elif not value and self._server is None:
            self._start()

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self.is_down = True

    def _start(self) -> None:
        self._server = server = _Server(("127.0.0.1", self._port), _Handler)
        server.owner, self._port = self, server.server_port
        threading.Thread(
            target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        ).start()

    def _stop(self) -> None:
        server, self._server = self._server, None
        server.shutdown()
        server.server_close()
        for connection in list(self.connections):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
