"""Connections to web servers with urllib3: kept and reused, direct or through a proxy.

urllib3 has the pools, the tunnels and TLS. This module adds proxies and certificates from the
environment, and closing while a thread waits for a server.
"""

import os
import re
import socket
import ssl
import threading
import urllib.request
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from ipaddress import ip_address, ip_network
from typing import Any, Self, TypeVar
from urllib.parse import SplitResult, urlsplit

import urllib3
from urllib3.exceptions import HTTPError, LocationParseError

from terrainwave.container.sources.addresses import basic_login, display_name, origin, without_login
from terrainwave.errors import StorageError
from terrainwave.extras import need

T = TypeVar("T")

# Largest number of simultaneous requests of a file; further threads wait.
N_CONNECTIONS = 16
# Variables with certificates: replacing the system's, or (OpenSSL's own) added to them.
_CERTIFICATES = {"REQUESTS_CA_BUNDLE": False, "CURL_CA_BUNDLE": False, "SSL_CERT_FILE": True}
_TUNNEL = re.compile(r"Tunnel connection failed: (\d{3})")


class ProxyStatus(Exception):
    """The proxy, not the server, returned the status that is its argument."""


class TooSlow(Exception):
    """A reply took longer than the seconds that are its argument."""


class _Watch:
    """Closes the connection of a reply that takes too long; a context manager."""

    def __init__(self, seconds: float) -> None:
        self.is_over = False
        self.sockets: list[Any] = []
        self._timer = threading.Timer(seconds, self._end)
        self._timer.daemon = True

    def _end(self) -> None:
        self.is_over = True
        for waiting in self.sockets:
            with suppress(OSError, AttributeError):
                waiting.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> Self:
        self._timer.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._timer.cancel()


class Connections:
    """Open connections to the servers of one file; for any number of threads."""

    def __init__(self) -> None:
        self._is_closed = False
        self.renew()

    def renew(self) -> None:
        """Reset after a fork; connections in use are left alone, as their locks may be held."""
        self._lock = threading.Lock()
        self._turns = threading.Semaphore(N_CONNECTIONS)
        self._managers: dict[tuple[str, str | None], urllib3.PoolManager] = {}
        self._pools: dict[tuple[str, str], tuple[Any, bool]] = {}
        self._sockets: weakref.WeakSet[Any] = weakref.WeakSet()
        self._here = threading.local()

    def get(
        self,
        url: SplitResult,
        headers: dict[str, str],
        timeout: float,
        take: Callable[[urllib3.HTTPResponse], T],
        most_seconds: float,
    ) -> T:
        """Request `url` and return the result of `take` on the reply.

        A kept connection that fails is replaced at once: servers close them at any time. Raises
        errors below urllib3, `ProxyStatus` if the proxy refuses the connection to the server,
        `TooSlow` if `most_seconds` have passed: a server may send single bytes, within `timeout`,
        forever.
        """
        with self._turns, _Watch(most_seconds) as watch:
            self._here.watch = watch
            if self._is_closed:
                raise OSError("closed")
            pool, is_forwarded = self._pool(url)
            target = url.path + (f"?{url.query}" if url.query else "")
            if is_forwarded:
                target = without_login(url)
            for may_be_stale in (True, False):
                self._here.is_fresh = False
                try:
                    return _exchange(pool, target, headers, timeout, take)
                except HTTPError as error:
                    cause = _cause(error)
                    if status := _TUNNEL.search(str(cause)):
                        raise ProxyStatus(int(status[1])) from error
                    if watch.is_over:
                        raise TooSlow(most_seconds) from error
                    if self._here.is_fresh or self._is_closed or not may_be_stale:
                        raise cause from error
                except OSError as error:
                    if watch.is_over:
                        raise TooSlow(most_seconds) from error
                    raise
        raise AssertionError("the second attempt returns or raises")

    def close(self) -> None:
        with self._lock:
            self._is_closed = True
            managers, self._managers, self._pools = self._managers, {}, {}
            sockets = list(self._sockets)
        for manager in managers.values():
            manager.clear()
        for waiting in sockets:
            with suppress(OSError, AttributeError):
                waiting.shutdown(socket.SHUT_RDWR)

    def _pool(self, url: SplitResult) -> tuple[Any, bool]:
        """Return the pool of a server, and whether it is a proxy's, which takes whole URLs."""
        key = (url.scheme, url.netloc)
        with self._lock:
            if key not in self._pools:
                way = url.scheme, proxy_of(url)
                if way not in self._managers:
                    self._managers[way] = _manager(*way)
                try:
                    pool = self._managers[way].connection_from_url(without_login(url))
                except LocationParseError as error:
                    raise StorageError(f"{without_login(url)}: {error}") from error
                pool.ConnectionCls = self._watched(pool.ConnectionCls)
                has_tunnel = url.scheme == "https" or (way[1] or "socks").startswith("socks")
                self._pools[key] = pool, not has_tunnel
            return self._pools[key]

    def _watched(self, base: Any) -> Any:
        """Return a class of connections that reports when they connect, and their socket."""
        connections = self

        class Watched(base):  # type: ignore[misc]
            def getresponse(self) -> Any:
                connections._here.watch.sockets.append(self.sock)
                return super().getresponse()

            def connect(self) -> None:
                connections._here.is_fresh = True
                super().connect()
                with connections._lock:
                    connections._sockets.add(self.sock)
                    if connections._is_closed:
                        raise OSError("closed")

        return Watched


def _manager(scheme: str, proxy: str | None) -> urllib3.PoolManager:
    options: dict[str, Any] = {"maxsize": N_CONNECTIONS}
    if scheme == "https":
        options["ssl_context"] = trusted()
    if proxy is None:
        return urllib3.PoolManager(**options)
    try:
        parts = urlsplit(proxy)
        if parts.scheme.startswith("socks"):
            need("socks", extra="remote", purpose=f"the proxy {display_name(proxy)}")
            from urllib3.contrib.socks import SOCKSProxyManager

            return SOCKSProxyManager(proxy, **options)
        login = basic_login(parts)
        return urllib3.ProxyManager(
            without_login(parts),
            proxy_headers={"Proxy-Authorization": login} if login else None,
            proxy_ssl_context=trusted() if parts.scheme == "https" else None,
            **options,
        )
    except (ValueError, HTTPError) as error:
        raise StorageError(
            f"the proxy {display_name(proxy)} has no address that can be asked; expected"
            " http://host:port"
        ) from error


def _exchange(
    pool: Any,
    target: str,
    headers: dict[str, str],
    timeout: float,
    take: Callable[[urllib3.HTTPResponse], T],
) -> T:
    response = pool.urlopen(
        "GET",
        target,
        headers=headers,
        retries=False,
        redirect=False,
        assert_same_host=False,
        timeout=timeout,
        preload_content=False,
        decode_content=False,
    )
    try:
        return take(response)
    finally:
        response.close()  # also closes the connection unless all of the reply was read
        response.release_conn()


def _cause(error: BaseException) -> Exception:
    while True:
        inner = next((item for item in error.args if isinstance(item, Exception)), None)
        inner = inner or error.__cause__  # type: ignore[assignment]
        if inner is None:
            return error if isinstance(error, OSError) else OSError(str(error))
        error = inner


def proxy_of(url: SplitResult) -> str | None:
    proxies = urllib.request.getproxies()
    proxy = proxies.get(url.scheme) or proxies.get("all")
    if not proxy or _is_near(url, proxies.get("no", "")):
        return None
    return proxy if "://" in proxy else f"http://{proxy}"


def _is_near(url: SplitResult, no_proxy: str) -> bool:
    """Return whether `no_proxy`, or the system, excludes a server from proxies."""
    _, host, port = origin(url)
    in_url = f"[{host}]" if ":" in host else host
    if any(map(urllib.request.proxy_bypass, (host, in_url, f"{in_url}:{port}"))):
        return True
    with suppress(ValueError):
        address = ip_address(host)
        for item in no_proxy.split(","):
            with suppress(ValueError):
                if address in ip_network(item.strip().strip("[]"), strict=False):
                    return True
    return False


def trusted() -> ssl.SSLContext:
    """Return the certificates to trust: those named by the environment, or the system's."""
    return _context(*map(os.environ.get, (*_CERTIFICATES, "SSL_CERT_DIR")))


@cache  # reading the system's takes 20 ms
def _context(*paths: str | None) -> ssl.SSLContext:
    for (name, is_added), path in zip(_CERTIFICATES.items(), paths, strict=False):
        if not path:
            continue
        is_folder = os.path.isdir(path)
        file, folder = (None, path) if is_folder else (path, None)
        try:
            if not is_added:
                return ssl.create_default_context(cafile=file, capath=folder)
            context = ssl.create_default_context()
            context.load_verify_locations(file, folder)
        except OSError as error:  # includes ssl.SSLError
            raise StorageError(
                f"{name} is {path}: found no certificates there, expected a file of them (PEM) or"
                " a folder; correct or unset it"
            ) from error
        return context
    return ssl.create_default_context()
