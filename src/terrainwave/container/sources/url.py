"""Byte sources behind a URL: http(s) with urllib3, archives, everything else with fsspec.

http does not use fsspec, because one request must give three answers: the size, whether the server
supports ranges, and the first 16 KiB. fsspec would need two more requests, and downloads the whole
file if ranges are ignored. Here a small file is then fetched whole, with a warning, and a large one
is refused.

Both store the version of the file they opened, also when pickled. http compares it with every
reply. fsspec cannot ask for it with a range: there checksums detect changed bytes, and
`check_unchanged` gives the reason.
"""

import http.client
import logging
import math
import re
import socket
import ssl
import threading
import time
import urllib.request
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, NamedTuple
from urllib.parse import SplitResult, urlsplit

from urllib3 import Retry
from urllib3.exceptions import HTTPError, InvalidHeader

from terrainwave.arguments import count_of
from terrainwave.container.sources.addresses import (
    basic_login,
    display_name,
    has_expired,
    is_signed,
    origin,
    redirected,
    split_chain,
    web_address,
    without_secrets,
)
from terrainwave.container.sources.byte_source import (
    MAX_WHOLE,
    ByteSource,
    FileSource,
)
from terrainwave.container.sources.connections import (
    N_CONNECTIONS,
    Connections,
    ProxyStatus,
    TooSlow,
    proxy_of,
)
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.container.sources.zip_member import open_member
from terrainwave.errors import (
    SourceUnavailableError,
    StorageError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.extras import need
from terrainwave.forks import renew_after_fork

_log = logging.getLogger(__name__)

FIRST_REQUEST = 16 * 1024
TIMEOUT = 30.0  # seconds without a byte
LEAST_RATE = 1024.0  # bytes per second, for each reply; sixteen may share a line
_REDIRECTS = {301, 302, 303, 307, 308}
_MAX_REDIRECTS = 5
_BUSY = {408, 425, 429, 500, 502, 503, 504}
_DELAYS = (0.2, 1.0)  # seconds before a retry of a busy server, or one that hung up
MAX_WAIT = 10.0  # seconds, if Retry-After asks for more
_RETRY = Retry()  # parses Retry-After
# Statuses that may mean an expired signature, and the bytes of their text to check.
_MAY_EXPIRE = {400, 401, 403}
_MAX_WORDS = 4096
_NO_LOGIN = (
    "the server wants a login ({}): write user and password before the host of the URL,"
    " user:password@host"
)
_WRONG_LOGIN = "the server refuses the user and password given ({})"
_DECODED = ("gzip", "x-gzip", "deflate")  # for whole files
# Errors that a retry does not help: no such host, no server, a bad certificate.
_LASTING = (socket.gaierror, ConnectionRefusedError, ssl.SSLCertVerificationError)
# Version of a file in fsspec's file systems, best first.
_VERSION_KEYS = ("ETag", "etag", "generation", "mtime", "LastModified", "last_modified", "created")
_CONTENT_RANGE = re.compile(r"bytes (?:(\d{1,18})-(\d{1,18})|\*)/(\d{1,18})")


def open_url(url: str) -> ByteSource:
    first, rest = split_chain(url)
    scheme, _, name = first.partition("://")
    if scheme.lower() in ("http", "https"):
        return HttpSource(url)
    if scheme.lower() == "file":
        return FileSource(urllib.request.url2pathname(urlsplit(url).path))
    if scheme.lower() == "zip":
        if not rest:
            raise StorageError(
                f"{display_name(url)}: found no archive, expected zip://FILE::ARCHIVE, such as"
                " zip://a.twz::archive.zip"
            )
        return open_member(name, open_url(rest) if "://" in rest else FileSource(rest))
    return FsspecSource(url)


class _Version(NamedTuple):
    """Version of a file according to a server."""

    etag: str | None = None
    modified: str | None = None

    def is_that_of(self, other: "_Version") -> bool:
        """Compare ETags, weak or strong, or else dates; an empty version matches every other."""
        if self.etag and other.etag:
            return self.etag.removeprefix("W/") == other.etag.removeprefix("W/")
        if self.modified and other.modified:
            return self.modified == other.modified
        return self == _Version()


class _Reply(NamedTuple):
    url: str
    status: int
    headers: Mapping[str, str]
    body: bytes = b""
    is_whole: bool = False
    proxy: str = ""  # set if it answered instead of the server

    @property
    def reason(self) -> str:
        return f"{self.status} {http.client.responses.get(self.status, '')}".rstrip()

    @property
    def version(self) -> _Version:
        return _Version(self.headers.get("ETag"), self.headers.get("Last-Modified"))

    @property
    def seconds_to_wait(self) -> float:
        with suppress(InvalidHeader, OverflowError, ValueError):
            return _RETRY.parse_retry_after(self.headers.get("Retry-After", ""))
        return 0.0


class _UrlSource(ByteSource):
    """A source whose requests are repeated; `n_replies` so far, for tests of waiting."""

    # Errors that say there is no file; errors of requests, and those that a retry may help.
    _absent: tuple[type[Exception], ...] = ()
    _failing: tuple[type[Exception], ...] = (OSError, http.client.HTTPException)
    _passing = _failing

    def __init__(self, url: str) -> None:
        self._url = url
        self.name = display_name(url)
        self.n_replies = 0

    def _repeat(self, ask: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Return the result of a request; of a busy server, or a failing one, the last."""
        for delay in (*_DELAYS, None):
            try:
                reply = ask(*args, **options)
                if not isinstance(reply, _Reply):  # these are counted as they come
                    self.n_replies += 1
                    return reply
                if delay is None or reply.status not in _BUSY:
                    return reply
                delay = max(delay, min(reply.seconds_to_wait, MAX_WAIT))
                reason = f"status {reply.status}"
            except TerrainwaveError:
                raise
            except self._absent as error:
                raise StorageError(f"cannot read {self.name}: no such file") from error
            except self._failing as error:
                is_passing = isinstance(error, self._passing) and not isinstance(error, _LASTING)
                if delay is None or not is_passing:
                    raise _unreadable(self.name, error) from error
                reason = type(error).__name__
            _log.info("%s: %s, asking again in %g s", self.name, reason, delay)
            self._wait(delay)
        raise AssertionError("the last attempt returns or raises")

    def _wait(self, seconds: float) -> None:
        time.sleep(seconds)


class HttpSource(_UrlSource):
    """A file on a web server with byte ranges, or a small one on a server without.

    Opening is one request, for the first 16 KiB. Every reply must have the `version` of the first
    one. Retries and messages are those of the JavaScript reader: docs/how-to/remote.md.
    """

    def __init__(self, url: str, version: _Version = _Version()) -> None:  # noqa: B008  immutable
        super().__init__(url)
        self._named = web_address(url)
        self._resolved = self._named
        self._connections = Connections()
        self.renew()
        renew_after_fork(self)
        self._is_closed = False
        self._version = version
        self._obeys_if_match = True
        self.size = -1
        try:
            self._start = self._request(ByteRange(0, FIRST_REQUEST))
        except BaseException:
            self.close()
            raise

    @property
    def version(self) -> str:
        return self._version.etag or self._version.modified or ""

    def renew(self) -> None:
        self._connections.renew()
        self._closing = threading.Event()

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
        """Return the existing bytes of `wanted`; sets `size` the first time."""
        reply = self._repeat(self._ask, wanted)
        if reply.status == 412 and self._obeys_if_match:
            # A weak ETag of the same file does not match: an unconditional reply decides.
            self._obeys_if_match = False
            reply = self._repeat(self._ask, wanted)
        match = _CONTENT_RANGE.fullmatch(reply.headers.get("Content-Range", "").strip())
        if reply.status == 416 and self.size == -1:
            if match and int(match[3]) == 0:
                self.size = 0
                return b""
            reply = self._repeat(self._ask, None)  # it does not clip ranges at the end of the file
        elif reply.status == 416 and match and int(match[3]) != self.size:
            raise _changed(self.name)
        if reply.status == 200:
            return self._take_whole(reply)
        if reply.status != 206:
            raise self._refused(reply)
        if coding := _coding(reply.headers):
            raise StorageError(
                f"{self.name}: the server sends parts of a compressed file (Content-Encoding:"
                f" {coding}), which nobody can read; store the file there without it"
            )
        if not match or match[1] is None:
            raise StorageError(f"{self.name}: no usable Content-Range in the server's reply")
        size = int(match[3])
        if self.size not in (-1, size) or not self._version.is_that_of(reply.version):
            raise _changed(self.name)
        expected = ByteRange(wanted.offset, min(wanted.end, size) - wanted.offset)
        if (int(match[1]), int(match[2]) + 1) != (expected.offset, expected.end):
            raise StorageError(
                f"{self.name}: the server sent {match[0]} for"
                f" bytes {expected.offset}-{expected.end - 1}"
            )
        self._learn(size, reply.version)
        return reply.body

    def _take_whole(self, reply: _Reply) -> bytes:
        """Read the whole file from a server without ranges, if it was opened that way."""
        coding = _coding(reply.headers)
        if coding and coding not in _DECODED:
            raise StorageError(
                f"{self.name}: the server sends the file with Content-Encoding: {coding}, which"
                " cannot be decoded here; store the file there without it"
            )
        if self.size != -1 or not reply.is_whole:
            raise StorageError(
                f"{self.name}: the server does not serve byte ranges; files of more than"
                f" {MAX_WHOLE >> 20} MiB are not fetched whole: download the file and open it"
                " locally, or host it where ranges work (nginx, Apache, S3, ...)"
            )
        if not self._version.is_that_of(reply.version):
            raise _changed(self.name)
        self._learn(len(reply.body), reply.version)
        warnings.warn(
            f"{self.name}: the server does not serve byte ranges, so all of the file was fetched,"
            f" {self.size:,} bytes",
            TerrainwaveWarning,
            stacklevel=2,
        )
        return reply.body

    def _learn(self, size: int, version: _Version) -> None:
        self.size = size
        etag, modified = self._version
        self._version = _Version(etag or version.etag, modified or version.modified)

    def _refused(self, reply: _Reply) -> StorageError:
        problem = f"HTTP status {reply.reason}"
        if reply.proxy and reply.status == 407:
            says = "refuses the user and password given"
            says = says if "@" in reply.proxy else "wants a user and password"
            problem = (
                f"the proxy {display_name(reply.proxy)} {says} ({reply.reason}); name them in"
                f" {self._named.scheme}_proxy, as http://user:password@host:port"
            )
        elif reply.proxy:
            problem = f"the proxy {display_name(reply.proxy)} answers {reply.reason}"
        elif reply.status == 401 and not is_signed(reply.url):
            problem = _WRONG_LOGIN if self._login(urlsplit(reply.url)) else _NO_LOGIN
            problem = problem.format(reply.reason)
        elif reply.status in _MAY_EXPIRE and has_expired(reply.url, reply.body.decode("latin-1")):
            problem = f"the URL has expired ({reply.reason}); get a new one and open it again"
        elif reply.status in _MAY_EXPIRE and is_signed(reply.url):
            problem += "; the URL is signed: it may have expired, or be signed for another request"
        elif reply.seconds_to_wait:
            problem += f"; the server asks to wait {math.ceil(reply.seconds_to_wait)} s"
        kind = SourceUnavailableError if reply.status in _BUSY else StorageError
        return kind(f"cannot read {self.name}: {problem}")

    def _wait(self, seconds: float) -> None:
        if self._is_closed or self._closing.wait(seconds):
            raise StorageError(f"{self.name} is closed")

    def _ask(self, wanted: ByteRange | None) -> _Reply:
        reply = self._follow(self._resolved, wanted)
        # The target of a redirect may be signed for a few minutes only.
        if reply.status in _MAY_EXPIRE | {404, 410} and self._resolved != self._named:
            reply = self._follow(self._named, wanted)
        return reply

    def _follow(self, url: SplitResult, wanted: ByteRange | None) -> _Reply:
        for _ in range(_MAX_REDIRECTS + 1):
            reply = self._exchange(url, wanted)
            location = reply.headers.get("Location")
            if reply.status not in _REDIRECTS or location is None:
                self._resolved = url
                return reply
            target = redirected(url.geturl(), location)
            if urlsplit(target).scheme not in ("https", url.scheme):
                raise StorageError(f"{self.name} redirects to {display_name(target)}")
            url = web_address(target)
        raise StorageError(f"{self.name} redirects more than {_MAX_REDIRECTS} times")

    def _exchange(self, url: SplitResult, wanted: ByteRange | None) -> _Reply:
        def take(response: Any) -> _Reply:
            reply = _read_reply(response, url.geturl(), wanted, takes_whole=self.size == -1)
            self.n_replies += 1
            part = "all" if wanted is None else f"bytes {wanted.offset} to {wanted.end}"
            _log.debug("%s: %s, status %d", self.name, part, reply.status)
            return reply

        try:
            n_bytes = MAX_WHOLE if wanted is None else wanted.length
            limit = TIMEOUT + n_bytes / LEAST_RATE
            reply = self._connections.get(url, self._headers(url, wanted), TIMEOUT, take, limit)
        except TooSlow as error:
            raise SourceUnavailableError(
                f"cannot read {self.name}: the server has not sent {count_of(n_bytes, 'byte')} in"
                f" {error.args[0]:,.0f} s; try again later"
            ) from error
        except ProxyStatus as error:
            reply = _Reply(url.geturl(), error.args[0], {}, proxy=proxy_of(url) or "?")
        if reply.status == 407 and not reply.proxy:
            return reply._replace(proxy=proxy_of(url) or "")
        return reply

    def _headers(self, url: SplitResult, wanted: ByteRange | None) -> dict[str, str]:
        headers = {
            "Accept-Encoding": "identity",  # ranges of a compressed reply would be useless
            "User-Agent": "terrainwave",
        }
        if wanted is not None:
            headers["Range"] = f"bytes={wanted.offset}-{wanted.end - 1}"
        etag = self._version.etag or ""
        if etag.startswith('"') and self._obeys_if_match:  # a strong ETag: weak ones never match
            headers["If-Match"] = etag
        if login := self._login(url):
            headers["Authorization"] = login
        return headers

    def _login(self, url: SplitResult) -> str | None:
        """Return the login for a URL: its own, or that of the opened URL for the same server."""
        named, other = origin(self._named), origin(url)
        is_same = named == other or (named[1] == other[1] and (named[2], other[2]) == (80, 443))
        return basic_login(url) or (basic_login(self._named) if is_same else None)

    def close(self) -> None:
        self._is_closed = True
        self._closing.set()
        self._connections.close()

    def __reduce__(self) -> tuple[type["HttpSource"], tuple[str, _Version]]:
        return HttpSource, (self._url, self._version)


def _changed(name: str) -> StorageError:
    return StorageError(f"{name} has changed while it was open: open it again")


def _unreadable(name: str, error: Exception) -> StorageError:
    problem = without_secrets(str(error).split("\n")[0]) or type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        problem = without_secrets(error.strerror)  # without its number
    if problem.startswith("Protocol not known"):  # text of fsspec's error
        problem += "; expected a path, or a URL of https or of another protocol that fsspec knows"
    may_pass = isinstance(error, OSError | http.client.HTTPException)
    if isinstance(error, ssl.SSLCertVerificationError):
        problem += (
            "; if your network signs certificates itself, name the file of its authority in"
            " SSL_CERT_FILE"
        )
    if isinstance(error, ssl.SSLCertVerificationError | PermissionError):
        may_pass = False
    kind = SourceUnavailableError if may_pass else StorageError
    return kind(f"cannot read {name}: {problem}")


def _coding(headers: Mapping[str, str]) -> str:
    coding = headers.get("Content-Encoding", "").strip().lower()
    return "" if coding == "identity" else coding


def _read_reply(response: Any, url: str, wanted: ByteRange | None, *, takes_whole: bool) -> _Reply:
    """Read a partial reply up to the wanted length, or a whole file up to `MAX_WHOLE`."""
    status, headers = response.status, response.headers
    reply = _Reply(url, status, headers)
    if status == 200 and takes_whole:
        is_coded = bool(_coding(headers))
        if is_coded and _coding(headers) not in _DECODED:
            return reply
        if (response.length_remaining or 0) > MAX_WHOLE:
            return reply
        body = _read_at_most(response, MAX_WHOLE + 1, decode_content=is_coded)
        return reply._replace(body=body, is_whole=len(body) <= MAX_WHOLE)
    if status == 206 and wanted is not None and not _coding(headers):
        has_length = "Content-Length" in headers or "Transfer-Encoding" in headers
        body = _read_at_most(response, wanted.length)
        match = _CONTENT_RANGE.fullmatch(headers.get("Content-Range", "").strip())
        if not has_length and match and match[1]:  # only this reveals a truncated reply
            missing = int(match[2]) + 1 - int(match[1]) - len(body)
            if missing > 0:
                raise http.client.IncompleteRead(body, missing)
        return reply._replace(body=body)
    if status in _MAY_EXPIRE:
        with suppress(HTTPError):
            return reply._replace(body=response.read(_MAX_WORDS))
    elif headers.get("Content-Length") == "0":
        response.read(1)
    return reply


def _read_at_most(response: Any, length: int, *, decode_content: bool = False) -> bytes:
    """Read up to `length` + 1 bytes; a connection read to the end can be reused."""
    parts = []
    while part := response.read(max(length, 1), decode_content=decode_content):
        parts.append(part[:length])
        length -= len(part)
        if length < 0:
            break
    return parts[0] if len(parts) == 1 else b"".join(parts)


class FsspecSource(_UrlSource):
    """A file on any storage of fsspec, of a required version: ``s3://``, ``gs://``, ..."""

    # File systems raise errors of their libraries, most of which are not OSErrors.
    _failing, _passing = (Exception,), (ConnectionError, TimeoutError)
    _absent = (FileNotFoundError,)

    def __init__(self, url: str, version: str | None = None) -> None:
        super().__init__(url)
        fsspec = need("fsspec", extra="remote", purpose=f"reading {self.name}")
        self._fs, self._path = self._repeat(fsspec.core.url_to_fs, url)
        info = self._info()
        if info.get("size") is None:
            raise StorageError(f"{self.name}: its size is not known; download it first")
        self.size = int(info["size"])
        self._version = _version_of(info)
        if version not in (None, self._version):
            raise _changed(self.name)

    @property
    def version(self) -> str:
        return self._version or ""

    def check_unchanged(self) -> None:
        info = self._info()
        if (info.get("size"), _version_of(info)) != (self.size, self._version):
            raise _changed(self.name)

    def _info(self) -> dict[str, Any]:
        self._fs.invalidate_cache(self._path)
        info: dict[str, Any] = self._repeat(self._fs.info, self._path)
        return info

    def _read(self, offset: int, length: int) -> bytes:
        return self._read_spans([ByteRange(offset, length)])[0]

    def _read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        asked = [span for span in spans if span.length]
        n_bytes = sum(span.length for span in asked)
        _log.debug("%s: %d ranges, %d bytes", self.name, len(asked), n_bytes)
        replies = self._repeat(
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
