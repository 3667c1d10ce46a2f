"""Addresses as clients see them, where a proxy stands between them and the server."""

import re
from collections.abc import Iterable
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network
from typing import NamedTuple
from urllib.parse import urlsplit

from fastapi.responses import JSONResponse
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from terrainwave.errors import InvalidArgumentError

Network = IPv4Network | IPv6Network

_LOOPBACK: tuple[Network, ...] = (IPv4Network("127.0.0.0/8"), IPv6Network("::1"))
_HOST = re.compile(r"(?P<name>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?")
# Without "%": a path that is decoded once more than it is checked could have other parts.
_PREFIX = re.compile(r"(/(?!\.{1,2}(/|$))[A-Za-z0-9._~!$&'()*+,;=:@-]+)*")
_EXPECTED = {
    "Proto": (re.compile("https?"), "http or https"),
    "Host": (_HOST, "a host name such as example.org, with a port or without"),
    "Prefix": (_PREFIX, "a path such as /terrain"),
}


class PublicUrl(NamedTuple):
    """Address of the server as browsers see it, and the host in it without a port."""

    address: str  # ends in a slash
    host: str


def public_url(text: str) -> PublicUrl:
    try:
        parts = urlsplit(text)
    except ValueError:  # brackets that do not pair, or hold no address
        parts = urlsplit("")
    host, path = _HOST.fullmatch(parts.netloc), parts.path.rstrip("/")
    is_whole = parts.scheme in ("http", "https") and not parts.query and not parts.fragment
    if not is_whole or host is None or not _PREFIX.fullmatch(path):
        raise InvalidArgumentError(
            f"found `public_url` {text!r}, expected http or https, a host and at most a path, such"
            " as https://example.org/terrain/"
        )
    return PublicUrl(f"{parts.scheme}://{parts.netloc}{path}/", host["name"])


def network_of(text: str) -> Network:
    try:
        return ip_network(text, strict=False)
    except ValueError as error:
        raise InvalidArgumentError(
            f"found `proxy` {text!r}, expected an IP address such as 10.0.0.7, or a network such"
            " as 10.0.0.0/8"
        ) from error


class Proxied:
    """Replaces scheme, host and path of requests by those that a trusted proxy forwards.

    A trusted proxy is on this machine, or at one of `proxies`. The headers are X-Forwarded-Proto,
    -Host and -Prefix; those of all other clients are ignored. Of several values, the last counts:
    the trusted proxy wrote it. `app` checks the host again.
    """

    def __init__(self, app: ASGIApp, proxies: Iterable[Network] = ()) -> None:
        self._app = app
        self._trusted = (*_LOOPBACK, *proxies)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and self._trusts(scope):
            forwarded = _forwarded(Headers(scope=scope))
            for name, value in forwarded.items():
                pattern, expected = _EXPECTED[name]
                if not pattern.fullmatch(value):
                    detail = f"found X-Forwarded-{name} {value[:80]!r}, expected {expected}"
                    await JSONResponse({"detail": detail}, 400)(scope, receive, send)
                    return
            scope = _as_forwarded(scope, forwarded)
        await self._app(scope, receive, send)

    def _trusts(self, scope: Scope) -> bool:
        try:
            address = ip_address((scope.get("client") or ("",))[0])
        except ValueError:
            return False
        if isinstance(address, IPv6Address) and address.ipv4_mapped:
            address = address.ipv4_mapped
        return any(address in network for network in self._trusted)


def _forwarded(headers: Headers) -> dict[str, str]:
    values = {name: headers.getlist(f"x-forwarded-{name}") for name in _EXPECTED}
    last = {name: found[-1].split(",")[-1].strip() for name, found in values.items() if found}
    return {name: value.rstrip("/") for name, value in last.items() if value}


def _as_forwarded(scope: Scope, forwarded: dict[str, str]) -> Scope:
    """Return a request as the proxy's client sent it. The proxy cut the prefix off the path."""
    scope = dict(scope)
    scope["scheme"] = forwarded.get("Proto", scope["scheme"])
    host, prefix = forwarded.get("Host"), forwarded.get("Prefix")
    own = Headers(scope=scope).get("host", "")
    # Many proxies forward the name alone, and pass on a Host with the port.
    if host is not None and _name_of(host) != _name_of(own):
        scope["headers"] = list(scope["headers"])
        MutableHeaders(scope=scope)["host"] = host
    if prefix:
        scope["root_path"] = prefix
        scope["path"] = prefix + scope["path"]
        if scope.get("raw_path") is not None:
            scope["raw_path"] = prefix.encode() + scope["raw_path"]
    return scope


def _name_of(host: str) -> str:
    match = _HOST.fullmatch(host)
    return match["name"].lower() if match else host


# Addresses that are answered in parts.
_RANGED = (".tif", ".twz")

# A page may use what comes with it and nothing else; workers of the map are blobs.
_CONTENT_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline';"
    " script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


def guards_of(*, cors: bool) -> dict[str, str]:
    return {
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": _CONTENT_POLICY,
        "Cross-Origin-Resource-Policy": "cross-origin" if cors else "same-origin",
        "Referrer-Policy": "same-origin",
    }


class Guarded:
    """Sends headers with every answer; takes ranges from requests for what is no raster.

    Starlette would send some hundred pieces of a file of the page. Through a middleware of its own
    kind each part of a body takes longer.
    """

    def __init__(self, app: ASGIApp, guards: dict[str, str]) -> None:
        self._app = app
        self._guards = guards

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(self._guards)
                # A server started anew may have another page and other terrains.
                headers.setdefault("Cache-Control", "no-cache")
            await send(message)

        if scope["type"] == "http" and not scope["path"].endswith(_RANGED):
            scope["headers"] = [item for item in scope["headers"] if item[0] != b"range"]
        await self._app(scope, receive, send_guarded)
