"""URLs: percent-encoding, display without secrets, chains, expiry of signatures."""

import base64
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from urllib.parse import SplitResult, parse_qsl, quote, unquote, urljoin, urlsplit

from terrainwave.errors import StorageError

DEFAULT_PORTS = {"http": 80, "https": 443}

# Separator of the links of a chain (zip://a.twz::https://...), but not within an IPv6 address.
_LINK = re.compile(r"::(?![^\[\]]*\])")
_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*://[^\s'\"<>]+")
_BARE_PERCENT = re.compile("%(?![0-9a-fA-F]{2})")
_BAD_PORT = re.compile(r":(?!\d*$)[^\]:]*$")
# Characters allowed in a path and a query without encoding, besides letters and digits (RFC 3986).
_PATH, _QUERY = "%/:@!$&'()*+,;=~-._", "%/:@!$&'()*+,;=~-._?"
# Query parameters with a signature, in small letters: S3, Google Cloud, Azure, CloudFront.
_SIGNATURES = {"x-amz-signature", "x-goog-signature", "signature", "sig"}
_TELLS_EXPIRY = re.compile("expired|not valid in the specified time frame", re.IGNORECASE)


def split_chain(url: str) -> tuple[str, str]:
    """Return the first link of a chain of URLs and the rest, which is "" for a single URL."""
    if url[:8].lower().startswith(("http://", "https://", "file://")):  # always the last link
        return url, ""
    first, *rest = _LINK.split(url, maxsplit=1)
    return first, rest[0] if rest else ""


def display_name(url: str) -> str:
    """Return a URL for messages: without login, query and fragment, which may hold secrets."""
    first, rest = split_chain(url)
    scheme, mark, address = first.partition("://")
    if mark:
        netloc = re.split("[/?#]", address, maxsplit=1)[0]
        if "@" in netloc:
            address = netloc.rpartition("@")[2] + address[len(netloc) :]
        elif _BAD_PORT.search(netloc):  # a password with an unencoded special letter
            address = address.rpartition("@")[2]
        first = scheme + mark + re.split("[?#]", address, maxsplit=1)[0]
    return f"{first}::{display_name(rest)}" if rest else first


def without_secrets(text: str) -> str:
    """Return another library's message with each URL as `display_name` shows it."""
    return _URL.sub(lambda found: display_name(found[0]), text)


def web_address(url: str) -> SplitResult:
    """Return the parts of a http(s) URL as sent to a server, in ASCII.

    Spaces and other invalid characters are percent-encoded; existing encoding stays. Host names are
    encoded by IDNA. The fragment is removed, the login stays.
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
    except ValueError as error:  # its message contains a part of the password
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
        # The text after the first @ may be the rest of a password instead of a host.
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
    return parts.scheme, parts.hostname or "", parts.port or DEFAULT_PORTS[parts.scheme]


def without_login(parts: SplitResult) -> str:
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()


def basic_login(parts: SplitResult) -> str | None:
    if parts.username is None:
        return None
    login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
    return "Basic " + base64.b64encode(login.encode()).decode()


def redirected(url: str, location: str) -> str:
    """Return the target of a Location header: servers write UTF-8, http.client reads Latin-1."""
    with suppress(UnicodeError):
        location = location.encode("latin-1").decode()
    return urljoin(url, location)


def is_signed(url: str) -> bool:
    return not _SIGNATURES.isdisjoint(_parameters(url))


def has_expired(url: str, reply: str) -> bool:
    if _TELLS_EXPIRY.search(reply):
        return True
    end = _end(_parameters(url)) if is_signed(url) else None
    return end is not None and end <= datetime.now(UTC)


def _parameters(url: str) -> dict[str, str]:
    return {name.lower(): value for name, value in parse_qsl(urlsplit(url).query)}


def _end(parameters: Mapping[str, str]) -> datetime | None:
    """Return the end of a signature's validity, if the query states it in a known way."""
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
