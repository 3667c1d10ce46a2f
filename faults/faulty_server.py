"""A local web server whose answers go wrong from one request on, or at one."""

import hashlib
import re
import socket
import struct
import threading
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Self

_RANGE = re.compile(r"bytes=(\d+)-(\d+)")
STALL = 1.0  # seconds, more than the client waits
_APART = 256  # bytes between flipped bits
_ENDLESS = 1 << 20  # bytes beyond the reply

# What a reply can be, beside a right one.
FAULTS = (
    "500", "503", "429", "404", "403", "reset", "hang-up", "cut body", "short body", "long body",
    "endless body", "stall", "stall in body", "garbage", "cut head", "redirect loop", "whole file",
    "other range", "other size", "no range", "flipped bits", "other file", "other ETag",
    "other Last-Modified", "no ETag", "replaced",
)  # fmt: skip


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        """Answer a range, rightly or not."""
        with suppress(OSError):
            self._answer(self.server.owner.fault_of_next())

    def _answer(self, fault: str) -> None:
        owner = self.server.owner
        content = owner.content
        if fault == "replaced":
            content = owner.other
        elif fault == "other file":  # of the same size and version
            content = owner.other[: len(content)].ljust(len(content))
        match = _RANGE.fullmatch(self.headers.get("Range", ""))
        first, last = int(match[1]), min(int(match[2]), len(content) - 1)
        body = content[first : last + 1]
        size = len(content)
        place = f"bytes {first}-{last}/{size}"
        headers = {"ETag": f'"{hashlib.md5(owner.content).hexdigest()}"'}
        if fault == "replaced":
            headers = {"ETag": f'"{hashlib.md5(content).hexdigest()}"'}
        if owner.has_dates:
            headers = {"Last-Modified": "Mon, 01 Jan 2024 00:00:00 GMT"}
        if fault == "other Last-Modified":
            headers = {"Last-Modified": "Tue, 02 Jan 2024 00:00:00 GMT"}
        if fault == "other ETag":
            headers = {"ETag": '"other"'}
        if fault == "no ETag":
            headers = {}
        if fault.isdigit():
            return self._reply(int(fault), b"no", headers)
        if fault == "redirect loop":
            return self._reply(302, b"", {"Location": self.path})
        if fault == "whole file":
            return self._reply(200, content, headers)
        if fault == "other range":
            place = f"bytes {first + 1}-{last + 1}/{size}"
        if fault == "other size":
            place = f"bytes {first}-{last}/{size + 1}"
        if fault == "flipped bits" and body:
            changed = bytearray(body)
            changed[::_APART] = (byte ^ 1 for byte in changed[::_APART])
            body = bytes(changed)
        headers["Content-Range"] = place
        if fault == "no range":
            del headers["Content-Range"]
        if fault == "reset":
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            return self._hang_up()
        if fault == "hang-up":
            return self._hang_up()
        if fault == "garbage":
            self.wfile.write(b"\x00\xff" * 100 + b"\r\n\r\n")
            return self._hang_up()
        if fault == "cut head":
            self.wfile.write(b"HTTP/1.1 206 Partial Content\r\nContent-Le")
            return self._hang_up()
        if fault == "stall":
            time.sleep(STALL)
            return self._hang_up()
        if fault == "short body":
            return self._reply(206, body[:-1], headers)
        if fault == "long body":
            return self._reply(206, body + b"more", headers)
        if fault == "endless body":
            self._reply(206, body + bytes(_ENDLESS), headers, length=1 << 50)
            return self._hang_up()
        if fault in ("cut body", "stall in body"):
            self._reply(206, body[: len(body) // 2], headers, length=len(body))
            time.sleep(STALL if fault == "stall in body" else 0)
            return self._hang_up()
        return self._reply(206, body, headers)

    def _hang_up(self) -> None:
        self.close_connection = True
        self.connection.close()

    def _reply(
        self, status: int, body: bytes, headers: dict[str, str], length: int | None = None
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def handle_error(self, *_: object) -> None:
        """Say nothing about clients that hang up."""


class FaultyServer:
    """Serves a file; a context manager.

    Parameters
    ----------
    content, other : bytes
        The file, and the one that faults serve in its place.

    `fault` happens at request number `first` (from 0) since `begin`, or at all from there on.
    """

    def __init__(self, content: bytes, other: bytes) -> None:
        self.content, self.other = content, other
        self.has_dates = False
        self._lock = threading.Lock()
        self.begin("", 0, lasts=False)

    def begin(self, fault: str, first: int, *, lasts: bool) -> None:
        """Count requests from 0 again, and let a fault happen; none if it is empty."""
        with self._lock:
            self._fault, self._first, self._lasts = fault, first, lasts
            self.has_dates = fault == "other Last-Modified"
            self.n_requests = 0

    def fault_of_next(self) -> str:
        """Return what goes wrong with the next reply."""
        with self._lock:
            number, self.n_requests = self.n_requests, self.n_requests + 1
            happens = number == self._first or (self._lasts and number > self._first)
            return self._fault if happens else ""

    @property
    def url(self) -> str:
        """Return the file's address."""
        return f"http://127.0.0.1:{self._server.server_port}/a.twz"

    def __enter__(self) -> Self:
        self._server = _Server(("127.0.0.1", 0), _Handler)
        self._server.owner = self
        threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        ).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
