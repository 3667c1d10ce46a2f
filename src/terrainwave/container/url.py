"""Byte sources behind a URL: http(s) by the standard library, everything else by fsspec.

http does without fsspec because one request must answer three questions: the size, whether the
server serves ranges at all, and what the first 16 KiB are. fsspec would need two more requests,
and downloads the whole file where ranges are ignored. Here a small file is fetched whole there,
with a warning, and a large one is refused.

Both remember which version of the file they opened, also when pickled. http compares it with every
reply. Storage behind fsspec has no way to ask for it with a range: there the checksums notice that
bytes are others, and `check_unchanged` says why.
"""

import base64
import http.client
import re
import socket
import ssl
import threading
import time
import urllib.request
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, NamedTuple
from urllib.parse import SplitResult, unquote, urljoin, urlsplit

from terrainwave.container.ranges import ByteRange
from terrainwave.container.source import ByteSource, FileSource, MergingSource
from terrainwave.errors import (
    SourceUnavailableError,
    StorageError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.extras import need
from terrainwave.forks import renew_after_fork

FIRST_REQUEST = 16 * 1024
TIMEOUT = 30.0  # seconds without a byte
N_CONNECTIONS = 16

# Files up to this size are fetched whole from servers that send no parts.
MAX_WHOLE = 64 << 20

_REDIRECTS = {301, 302, 303, 307, 308}
_MAX_REDIRECTS = 5
_BUSY = {429, 500, 502, 503, 504}
_DELAYS = (0.2, 1.0)  # seconds before a busy server, or one that hung up, is asked again
# What asking again does not help against: no such host, no server there, a bad certificate.
_LASTING = (socket.gaierror, ConnectionRefusedError, ssl.SSLCertVerificationError)
# What file systems of fsspec tell about the version of a file, best first.
_VERSION_KEYS = ("ETag", "etag", "generation", "mtime", "LastModified", "last_modified", "created")
_CONTENT_RANGE = re.compile(r"bytes (?:(\d{1,18})-(\d{1,18})|\*)/(\d{1,18})")


def open_url(url: str) -> ByteSource:
    """Return the source of a URL; raise `StorageError` if it cannot be read so."""
    try:
        parts = urlsplit(url)
        _ = parts.port  # looked at only when it is asked for
    except ValueError as error:
        raise StorageError(f"{url} is not a URL: {error}") from error
    scheme = parts.scheme.lower()
    if scheme in ("http", "https"):
        return HttpSource(url)
    if scheme == "file":
        return FileSource(urllib.request.url2pathname(parts.path))
    return FsspecSource(url)


class _Reply(NamedTuple):
    status: int
    location: str | None
    content_range: str | None
    version: str | None
    body: bytes
    length: int = 0  # of the whole body, as the server says


class HttpSource(MergingSource):
    """A file on a web server that serves byte ranges, or a small one on one that does not.

    Opening is one request, for the first 16 KiB. Connections are kept and reused, up to sixteen
    at a time. Redirects, `http_proxy` and friends and ``user:password@`` in the URL work.

    Parameters
    ----------
    version : str, optional
        The ETag, or else the Last-Modified, that every reply must carry; by default that of the
        first reply.
    """

    def __init__(self, url: str, version: str | None = None) -> None:
        self._url = url
        self.name = _display_name(url)
        self._idle: list[tuple[tuple[str, str], http.client.HTTPConnection]] = []
        self.n_replies = 0  # so far, for those who wait
        self.renew()
        renew_after_fork(self)
        self._is_closed = False
        self._resolved = url
        self._version = version
        self.size = -1
        try:
            self._start = self._request(ByteRange(0, FIRST_REQUEST))
        except BaseException:
            self.close()
            raise

    def renew(self) -> None:
        """Begin anew after a fork: on the parent's connections each would read the other's bytes.

        Those in use are left as they are: their locks may be held.
        """
        self._lock = threading.Lock()
        idle, self._idle = self._idle, []
        self._in_use: set[http.client.HTTPConnection] = set()
        for _, connection in idle:
            connection.close()

    def _read(self, offset: int, length: int) -> bytes:
        if self._is_closed:
            raise StorageError(f"{self.name} is closed")
        if offset + length <= len(self._start):
            return self._start[offset : offset + length]
        return self._request(ByteRange(offset, length))

    def _read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        if len(spans) < 2:
            return super()._read_spans(spans)
        with ThreadPoolExecutor(min(len(spans), N_CONNECTIONS)) as pool:
            return list(pool.map(lambda span: self.read(*span), spans))

    def _request(self, wanted: ByteRange) -> bytes:
        """Return the bytes of `wanted` that exist; sets `size` the first time."""
        reply = self._ask(wanted)
        match = _CONTENT_RANGE.fullmatch((reply.content_range or "").strip())
        if reply.status == 412:
            raise _changed(self.name)
        if reply.status == 416 and match and int(match[3]) == 0 and self.size < 1:
            self.size = 0
            return b""
        if reply.status == 416 and match and int(match[3]) != self.size:
            raise _changed(self.name)
        if reply.status == 200:
            return self._take_whole(reply)
        if reply.status != 206:
            reason = http.client.responses.get(reply.status, "")
            kind = SourceUnavailableError if reply.status in _BUSY else StorageError
            raise kind(f"cannot read {self.name}: {reply.status} {reason}".rstrip())
        if not match or match[1] is None:
            raise StorageError(f"{self.name}: no usable Content-Range in the server's reply")
        size = int(match[3])
        if self.size not in (-1, size) or self._version not in (None, reply.version):
            raise _changed(self.name)
        expected = ByteRange(wanted.offset, min(wanted.end, size) - wanted.offset)
        if (int(match[1]), int(match[2]) + 1) != (expected.offset, expected.end):
            raise StorageError(f"{self.name}: the server sent {match[0]} for {expected}")
        self.size, self._version = size, reply.version
        return reply.body

    def _take_whole(self, reply: _Reply) -> bytes:
        """Take the whole file from a server that sends no parts, if that is how it was opened."""
        if self.size != -1 or len(reply.body) < reply.length or len(reply.body) > MAX_WHOLE:
            raise StorageError(
                f"{self.name}: the server does not serve byte ranges; files of more than"
                f" {MAX_WHOLE >> 20} MiB are not fetched whole: download the file and open it"
                " locally, or host it where ranges work (nginx, Apache, S3, ...)"
            )
        if self._version not in (None, reply.version):
            raise _changed(self.name)
        self.size, self._version = len(reply.body), reply.version
        warnings.warn(
            f"{self.name}: the server does not serve byte ranges, so all of the file was fetched,"
            f" {self.size:,} bytes",
            TerrainwaveWarning,
            stacklevel=2,
        )
        return reply.body

    def _ask(self, wanted: ByteRange) -> _Reply:
        """Return the first reply that is no redirect and no sign of a busy server."""
        for delay in _DELAYS:
            try:
                reply = self._ask_once(wanted)
                if reply.status not in _BUSY:
                    return reply
            except _LASTING as error:
                raise _unreadable(self.name, error) from error
            except (OSError, http.client.HTTPException):
                pass
            if self._is_closed:
                raise StorageError(f"{self.name} is closed")
            time.sleep(delay)
        try:
            return self._ask_once(wanted)
        except (OSError, http.client.HTTPException) as error:
            raise _unreadable(self.name, error) from error

    def _ask_once(self, wanted: ByteRange) -> _Reply:
        reply = self._follow(self._resolved, wanted)
        # What a redirect pointed at may have been signed for a few minutes only.
        if reply.status in (401, 403, 404, 410) and self._resolved != self._url:
            reply = self._follow(self._url, wanted)
        return reply

    def _follow(self, url: str, wanted: ByteRange) -> _Reply:
        for _ in range(_MAX_REDIRECTS + 1):
            reply = self._exchange(url, wanted)
            if reply.status not in _REDIRECTS or reply.location is None:
                self._resolved = url
                return reply
            target = urljoin(url, reply.location)
            if urlsplit(target).scheme not in ("https", urlsplit(url).scheme):
                raise StorageError(f"{self.name} redirects to {_display_name(target)}")
            url = target
        raise StorageError(f"{self.name} redirects more than {_MAX_REDIRECTS} times")

    def _exchange(self, url: str, wanted: ByteRange) -> _Reply:
        """Ask once, on a kept connection if there is one; once more if that had gone stale."""
        parts = urlsplit(url)
        key = (parts.scheme, parts.netloc)
        while True:
            connection = self._take_idle(key)
            is_fresh = connection is None
            if connection is None:
                connection = self._connect(parts)
            is_reusable = False
            with self._lock:
                self._in_use.add(connection)
            try:
                connection.request("GET", _target(parts), headers=self._headers(parts, wanted))
                response = connection.getresponse()
                reply = _read_reply(response, wanted.length, takes_whole=self.size == -1)
                self.n_replies += 1
                is_reusable = response.isclosed() and not response.will_close
                return reply
            except (OSError, http.client.HTTPException):
                if is_fresh or self._is_closed:
                    raise
            finally:
                self._give_back(key, connection, is_reusable)

    def _headers(self, parts: SplitResult, wanted: ByteRange) -> dict[str, str]:
        headers = {
            "Range": f"bytes={wanted.offset}-{wanted.end - 1}",
            "Accept-Encoding": "identity",  # ranges of a compressed reply would be useless
            "User-Agent": "terrainwave",
        }
        if (self._version or "").startswith('"'):  # a strong ETag: weak ones never match
            headers["If-Match"] = str(self._version)
        # Only to the server the user named, not to one it redirects to.
        if parts.username is not None and parts.netloc == urlsplit(self._url).netloc:
            login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
            headers["Authorization"] = "Basic " + base64.b64encode(login.encode()).decode()
        return headers

    def _connect(self, parts: SplitResult) -> http.client.HTTPConnection:
        try:
            host, port = parts.hostname or "", parts.port
        except ValueError as error:
            raise StorageError(f"{self.name}: {error}") from None
        if not host:
            raise StorageError(f"{self.name}: no host in the URL")
        proxy = _proxy(parts)
        at_host, at_port = (proxy.hostname or "", proxy.port) if proxy else (host, port)
        if parts.scheme == "http":
            return http.client.HTTPConnection(at_host, at_port, timeout=TIMEOUT)
        context = ssl.create_default_context()
        connection = http.client.HTTPSConnection(at_host, at_port, timeout=TIMEOUT, context=context)
        if proxy:
            connection.set_tunnel(host, port)
        return connection

    def _take_idle(self, key: tuple[str, str]) -> http.client.HTTPConnection | None:
        with self._lock:
            for number, (idle_key, connection) in enumerate(self._idle):
                if idle_key == key:
                    del self._idle[number]
                    return connection
        return None

    def _give_back(
        self, key: tuple[str, str], connection: http.client.HTTPConnection, is_reusable: bool
    ) -> None:
        with self._lock:
            self._in_use.discard(connection)
            if is_reusable and not self._is_closed and len(self._idle) < N_CONNECTIONS:
                self._idle.append((key, connection))
                return
        connection.close()

    def close(self) -> None:
        """Close all connections; who waits for one is told so."""
        with self._lock:
            self._is_closed = True
            idle, self._idle = self._idle, []
            sockets = [connection.sock for connection in self._in_use if connection.sock]
        for _, connection in idle:
            connection.close()
        for waiting in sockets:
            with suppress(OSError):
                waiting.shutdown(socket.SHUT_RDWR)

    def __reduce__(self) -> tuple[type["HttpSource"], tuple[str, str | None]]:
        return HttpSource, (self._url, self._version)


def _changed(name: str) -> StorageError:
    return StorageError(f"{name} has changed while it was open: open it again")


def _unreadable(name: str, error: Exception) -> StorageError:
    problem = str(error).split("\n")[0] or type(error).__name__
    may_pass = isinstance(error, OSError | http.client.HTTPException)
    if isinstance(error, ssl.SSLCertVerificationError | PermissionError):
        may_pass = False
    kind = SourceUnavailableError if may_pass else StorageError
    return kind(f"cannot read {name}: {problem}")


def _read_reply(
    response: http.client.HTTPResponse, length: int, *, takes_whole: bool = False
) -> _Reply:
    """Read what there is of a partial reply, `length` bytes at most, and nothing of others.

    `takes_whole` reads a complete file too, unless it is longer than `MAX_WHOLE`.
    """
    body, whole_length = b"", 0
    if response.status == 200 and takes_whole:
        whole_length = response.length or 0
        if whole_length <= MAX_WHOLE:
            body = response.read(MAX_WHOLE + 1)
            if len(body) < whole_length:
                raise http.client.IncompleteRead(body, whole_length - len(body))
    elif response.status == 206:
        body = response.read(length)
        if response.length and len(body) < length:  # hung up: http.client says nothing
            raise http.client.IncompleteRead(body, response.length)
        response.read(1)  # lets http.client notice the end, so that the connection can be reused
    elif response.getheader("Content-Length", "") == "0":
        response.read()
    location, content_range = response.getheader("Location"), response.getheader("Content-Range")
    version = response.getheader("ETag") or response.getheader("Last-Modified")
    return _Reply(response.status, location, content_range, version, body, whole_length)


def _target(parts: SplitResult) -> str:
    target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    if parts.scheme == "http" and _proxy(parts):
        netloc = parts.netloc.rpartition("@")[2]
        return f"http://{netloc}{target}"
    return target


def _proxy(parts: SplitResult) -> SplitResult | None:
    proxy = urllib.request.getproxies().get(parts.scheme)
    if not proxy or urllib.request.proxy_bypass(parts.hostname or ""):
        return None
    return urlsplit(proxy if "://" in proxy else f"http://{proxy}")


def _display_name(url: str) -> str:
    """Return the URL for messages: without password, query and fragment, where secrets live."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"


class FsspecSource(MergingSource):
    """A file on anything fsspec knows: ``s3://``, ``gs://``, ``memory://``, ...

    Parameters
    ----------
    version : str, optional
        What the file system must say of the file's version; by default what it says now.
    """

    def __init__(self, url: str, version: str | None = None) -> None:
        self._url = url
        self.name = _display_name(url)
        self.n_replies = 0  # so far, for those who wait
        fsspec = need("fsspec", extra="remote", purpose=f"reading {self.name}")
        self._fs, self._path = self._call(fsspec.core.url_to_fs, url)
        info = self._info()
        if info.get("size") is None:
            raise StorageError(f"{self.name}: its size is not known; download it first")
        self.size = int(info["size"])
        self._version = _version_of(info)
        if version not in (None, self._version):
            raise _changed(self.name)

    def check_unchanged(self) -> None:
        """Raise `StorageError` if the file is another one than was opened: one request."""
        info = self._info()
        if (info.get("size"), _version_of(info)) != (self.size, self._version):
            raise _changed(self.name)

    def _info(self) -> dict[str, Any]:
        self._fs.invalidate_cache(self._path)
        info: dict[str, Any] = self._call(self._fs.info, self._path)
        return info

    def _call(self, function: Any, *args: Any, **options: Any) -> Any:
        # File systems raise what their libraries raise; few of those are OSErrors.
        for delay in (*_DELAYS, None):
            try:
                result = function(*args, **options)
                self.n_replies += 1
                return result
            except TerrainwaveError:
                raise
            except FileNotFoundError as error:
                raise StorageError(f"cannot read {self.name}: no such file") from error
            except Exception as error:
                is_passing = isinstance(error, ConnectionError | TimeoutError)
                if delay is None or not is_passing or isinstance(error, _LASTING):
                    raise _unreadable(self.name, error) from error
                time.sleep(delay)
        raise AssertionError("the last attempt returns or raises")

    def _read(self, offset: int, length: int) -> bytes:
        return self._read_spans([ByteRange(offset, length)])[0]

    def _read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        asked = [span for span in spans if span.length]
        replies = self._call(
            self._fs.cat_ranges,
            [self._path] * len(asked),
            [span.offset for span in asked],
            [span.end for span in asked],
            on_error="raise",
        )
        data_of = dict(zip(asked, replies, strict=True))
        for span, data in data_of.items():
            if len(data) != span.length:
                self.check_unchanged()
            if len(data) > span.length:
                raise StorageError(f"{self.name} does not serve byte ranges; download it first")
            self._check_length(span, data)
        return [data_of.get(span, b"") for span in spans]

    def __reduce__(self) -> tuple[type["FsspecSource"], tuple[str, str | None]]:
        return FsspecSource, (self._url, self._version)


def _version_of(info: dict[str, Any]) -> str | None:
    return next((str(info[key]) for key in _VERSION_KEYS if info.get(key) is not None), None)
