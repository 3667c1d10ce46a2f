"""What URLs say: how they are asked for, what messages may show, chains, when they expire."""

import base64
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from urllib.parse import SplitResult, parse_qsl, quote, unquote, urljoin, urlsplit

from terrainwave.errors import StorageError

DEFAULT_PORTS = {"http": 80, "https": 443}

# Between the links of a chain (zip://a.twz::https://...), not within an IPv6 address.
_LINK = re.compile(r"::(?![^\[\]]*\])")
_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*://[^\s'\"<>]+")
_BARE_PERCENT = re.compile("%(?![0-9a-fA-F]{2})")
_BAD_PORT = re.compile(r":(?!\d*$)[^\]:]*$")
# What may stand in a path and a query as it is, besides letters and digits (RFC 3986).
_PATH, _QUERY = "%/:@!$&'()*+,;=~-._", "%/:@!$&'()*+,;=~-._?"
# Parameters of a query that is a signature, in small letters: S3, Google Cloud, Azure, CloudFront.
_SIGNATURES = {"x-amz-signature", "x-goog-signature", "signature", "sig"}
_TELLS_EXPIRY = re.compile("expired|not valid in the specified time frame", re.IGNORECASE)


def split_chain(url: str) -> tuple[str, str]:
    """Return the first link of a chain of URLs and the rest, which is "" where it is no chain."""
    if url[:8].lower().startswith(("http://", "https://", "file://")):  # always the last link
        return url, ""
    first, *rest = _LINK.split(url, maxsplit=1)
    return first, rest[0] if rest else ""


def display_name(url: str) -> str:
    """Return a URL for messages: without login, query and fragment, where secrets live."""
    first, rest = split_chain(url)
    scheme, mark, address = first.partition("://")
    if mark:
        netloc = re.split("[/?#]", address, maxsplit=1)[0]
        if "@" in netloc:
            address = netloc.rpartition("@")[2] + address[len(netloc) :]
        elif _BAD_PORT.search(netloc):  # a password with a letter that ought to be encoded
            address = address.rpartition("@")[2]
        first = scheme + mark + re.split("[?#]", address, maxsplit=1)[0]
    return f"{first}::{display_name(rest)}" if rest else first


def without_secrets(text: str) -> str:
    """Return a message of another library with each URL in it as `display_name` has it."""
    return _URL.sub(lambda found: display_name(found[0]), text)


def web_address(url: str) -> SplitResult:
    """Return the parts of a http(s) URL as a server is asked for them, in ASCII.

    Spaces, other letters and whatever else may not stand in a URL are percent-encoded; what is
    encoded stays. Host names become those of IDNA. The fragment is left out, the login stays.

    Raises
    ------
    StorageError
        If no server can be asked for it.
    """
    try:
        parts = urlsplit(url)
        host = parts.hostname or ""
        if not host.isascii():
            host = host.encode("idna").decode()
    except ValueError as error:
        problem = without_secrets(str(error))
        raise StorageError(f"{display_name(url)} is not a URL: {problem}") from error
    try:
        port = parts.port
    except ValueError as error:  # its words have a part of the password
        raise StorageError(
            f"{display_name(url)} is not a URL: expected a number below 65536 as port (/, ? and #"
            " in a password are written %2F, %3F and %23)"
        ) from error
    if not host:
        raise StorageError(
            f"{display_name(url)}: found no host, expected a URL such as https://example.org/a.twz"
        )
    login, at, _ = parts.netloc.rpartition("@")
    if at and "@" in parts.path + parts.query + parts.fragment:
        # What follows the first @ may be the rest of a password, and no host.
        raise StorageError(
            f"{parts.scheme.lower()}://… has a user and password and one @ more; expected @, /, ?"
            " and # in them to be written %40, %2F, %3F and %23, and @ in the path %40"
        )
    host = f"[{host}]" if ":" in host else host
    netloc = login + at + host + (f":{port}" if port is not None else "")
    path, query = (
        quote(_BARE_PERCENT.sub("%25", part), safe, "utf-8", "surrogateescape")
        for part, safe in ((parts.path or "/", _PATH), (parts.query, _QUERY))
    )
    return SplitResult(parts.scheme.lower(), netloc, path, query, "")


def origin(parts: SplitResult) -> tuple[str, str, int]:
    """Return scheme, host and port."""
    return parts.scheme, parts.hostname or "", parts.port or DEFAULT_PORTS[parts.scheme]


def without_login(parts: SplitResult) -> str:
    """Return the URL without user and password."""
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()


def basic_login(parts: SplitResult) -> str | None:
    """Return the header that user and password of a URL ask for."""
    if parts.username is None:
        return None
    login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
    return "Basic " + base64.b64encode(login.encode()).decode()


def redirected(url: str, location: str) -> str:
    """Return where a Location header leads: servers write UTF-8, http.client reads Latin-1."""
    with suppress(UnicodeError):
        location = location.encode("latin-1").decode()
    return urljoin(url, location)


def is_signed(url: str) -> bool:
    """Say whether the query has a signature, as links have that storage gives for some time."""
    return not _SIGNATURES.isdisjoint(_parameters(url))


def has_expired(url: str, reply: str) -> bool:
    """Say whether a refused URL has expired, by its own query or by the words of the reply."""
    if _TELLS_EXPIRY.search(reply):
        return True
    end = _end(_parameters(url)) if is_signed(url) else None
    return end is not None and end <= datetime.now(UTC)


def _parameters(url: str) -> dict[str, str]:
    return {name.lower(): value for name, value in parse_qsl(urlsplit(url).query)}


def _end(parameters: Mapping[str, str]) -> datetime | None:
    """Return until when a signature holds, if the query says so in a known way."""
    with suppress(ValueError, OverflowError, OSError):
        for cloud in ("x-amz", "x-goog"):
            if f"{cloud}-date" in parameters:
                start = datetime.strptime(parameters[f"{cloud}-date"], "%Y%m%dT%H%M%SZ")
                seconds = int(parameters.get(f"{cloud}-expires", ""))
                return start.replace(tzinfo=UTC) + timedelta(seconds=seconds)
        if "se" in parameters:  # Azure
            end = datetime.fromisoformat(parameters["se"])
            return end if end.tzinfo else end.replace(tzinfo=UTC)
        if "expires" in parameters:  # S3 and Google Cloud before version 4, CloudFront
            return datetime.fromtimestamp(int(parameters["expires"]), UTC)
    return None
