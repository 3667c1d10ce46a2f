"""What common clients bring: proxies, certificates, addresses of all kinds, logins, old servers.

What replies lead to is in test_http_policy.py.
"""

import base64
import re
import select
import socket
import ssl
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from servers import running

from terrainwave.container.sources import url as module
from terrainwave.container.sources.addresses import display_name, without_secrets
from terrainwave.container.sources.opening import open_source
from terrainwave.errors import SourceUnavailableError, StorageError

TLS = Path(__file__).parent / "tls"
AUTHORITY, CERTIFICATE = TLS / "authority.pem", TLS / "server.pem"
DATA = bytes(i * 7 % 251 for i in range(40_000))
VARIABLES = (
    "http_proxy", "https_proxy", "all_proxy", "no_proxy", "ftp_proxy",
    "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "SSL_CERT_FILE", "SSL_CERT_DIR",
)  # fmt: skip


@pytest.fixture(autouse=True)
def plain_environment(monkeypatch):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    monkeypatch.setattr(module, "_DELAYS", (0.0, 0.0))
    monkeypatch.setattr(module, "TIMEOUT", 5.0)


class Handler(BaseHTTPRequestHandler):
    """A server of one file, a redirect, or a proxy; ``server.plan`` says which."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self):
        server = self.server
        server.asked.append(self.path)
        server.clients.add(self.client_address)
        server.logins.append(self.headers.get("Authorization"))
        if server.proxy_login is not None and not self.has_proxy_login():
            return None
        if target := server.redirects.get(self.path):
            # As servers that don't encode write it.
            target = target if isinstance(target, bytes) else target.encode()
            location = target.decode("latin-1")
            return self.send(302, b"", Location=location)
        if status := server.statuses.get(self.path):
            return self.send(status, b"")
        first, last = map(int, re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers["Range"]).groups())
        body = DATA[first : last + 1]
        place = f"bytes {first}-{first + len(body) - 1}/{len(DATA)}"
        if server.resets and first:
            server.resets -= 1
            self.send(206, body[:10], length=len(body), **{"Content-Range": place})
            self.wfile.flush()
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.close_connection = True
            self.connection.close()
            return None
        return self.send(206, body, **{"Content-Range": place})

    def do_CONNECT(self):
        server = self.server
        server.asked.append(self.path)
        if server.proxy_login is not None and not self.has_proxy_login():
            return
        if server.tunnel_status != 200:
            self.send(server.tunnel_status, b"")
            return
        host, _, port = self.path.rpartition(":")
        place = server.tunnel_to or (host.strip("[]"), int(port))
        with socket.create_connection(place) as other:
            self.send_response(200)
            self.end_headers()
            pump(self.connection, other)
        self.close_connection = True

    def has_proxy_login(self):
        login = self.headers.get("Proxy-Authorization")
        expected = "Basic " + base64.b64encode(self.server.proxy_login.encode()).decode()
        if login != expected:
            self.send(407, b"", **{"Proxy-Authenticate": 'Basic realm="proxy"'})
        return login == expected

    def send(self, status, body, length=None, **headers):
        self.send_response(status)
        if self.protocol_version > "HTTP/1.0":
            self.send_header("Content-Length", str(len(body) if length is None else length))
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


def pump(one, other):
    """Pass bytes on in both directions until an end is closed."""
    ends = {one: other, other: one}
    while True:
        for ready in select.select(list(ends), [], [], 10)[0]:
            try:
                data = ready.recv(65536)
                ends[ready].sendall(data)
            except OSError:
                return
            if not data:
                return


class Server(ThreadingHTTPServer):
    """Quiet about clients that hang up."""

    daemon_threads = True

    def __init__(self, host="127.0.0.1", handler=Handler, tls=False):
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, 0), handler)
        self.asked, self.logins, self.redirects, self.statuses = [], [], {}, {}
        self.proxy_login, self.tunnel_status, self.resets = None, 200, 0
        self.tunnel_to, self.clients = None, set()
        host = f"[{host}]" if ":" in host else host
        self.place = f"{host}:{self.server_port}"
        self.url = f"{'https' if tls else 'http'}://{self.place}"
        if tls:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(CERTIFICATE)
            self.socket = context.wrap_socket(
                self.socket, server_side=True, do_handshake_on_connect=False
            )

    def handle_error(self, *_):
        pass


def serving(**options):
    return running(Server(**options))


@pytest.fixture
def server():
    with serving() as running:
        yield running


@pytest.fixture
def proxy():
    with serving() as running:
        yield running


def reads(address):
    """Open a file, read a part of it, and say whether it is right."""
    source = open_source(address)
    try:
        return source.read(30_000, 100) == DATA[30_000:30_100]
    finally:
        source.close()


def problem(address):
    with pytest.raises(StorageError) as caught:
        reads(address)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("location", "asked"),
    [
        ("/größe 1.twz", "/gr%C3%B6%C3%9Fe%201.twz"),
        ("HOST/a b/山.twz?x=ü y", "/a%20b/%E5%B1%B1.twz?x=%C3%BC%20y"),
        ("b c.twz", "/dir/b%20c.twz"),
        ("/already%20there.twz", "/already%20there.twz"),
    ],
)
def test_a_redirect_to_spaces_and_other_letters_is_followed(server, location, asked):
    server.redirects["/dir/a"] = location.replace("HOST", server.url)
    assert reads(server.url + "/dir/a")
    assert server.asked == ["/dir/a", asked, asked]


def test_a_host_of_other_letters_is_asked_for_by_its_ascii_name(monkeypatch, proxy):
    monkeypatch.setenv("http_proxy", proxy.url)
    assert reads("http://bücher.example/a")
    assert proxy.asked[0] == "http://xn--bcher-kva.example/a"


@pytest.mark.parametrize(
    ("url", "place"),
    [
        ("http://[::1]/a", ("::1", 80)),
        ("https://[::1]/a", ("::1", 443)),
        ("http://[fe80::1%25lo]/a", ("fe80::1%lo", 80)),
    ],
)
def test_an_ipv6_address_has_the_port_of_its_scheme(monkeypatch, url, place):
    asked = []

    def find(host, port, *_, **__):
        asked.append((host, port))
        raise ConnectionRefusedError("not here")

    monkeypatch.setattr(socket, "getaddrinfo", find)
    assert "not here" in problem(url)
    assert asked == [place]


@pytest.mark.parametrize(
    "url", ["http://[::1/a", "http://a:b/c", "http://:80/", "http://a b/c", "http://" + "ü" * 70]
)
def test_what_is_no_address_is_one_clear_line(url):
    problem(url)


def test_a_login_goes_on_to_the_same_server_and_to_no_other(server):
    basic = "Basic " + base64.b64encode("mé:se@cret".encode()).decode()
    address = server.url.replace("//", "//m%C3%A9:se%40cret@") + "/a"
    server.redirects["/a"] = server.url + "/b"
    assert reads(address)
    assert server.logins == [basic] * 3
    with serving() as other:
        server.redirects["/a"] = other.url + "/b"
        assert reads(address)
        assert other.logins == [None] * 2


def test_a_login_goes_on_to_https_of_the_same_host(proxy, monkeypatch):
    monkeypatch.setenv("SSL_CERT_FILE", str(AUTHORITY))
    monkeypatch.setenv("all_proxy", proxy.url)
    proxy.redirects["http://localhost/a"] = "https://localhost/b"
    with serving(tls=True) as server:
        proxy.tunnel_to = server.server_address
        assert reads("http://me:secret@localhost/a")
        assert server.logins == ["Basic " + base64.b64encode(b"me:secret").decode()] * 2
        proxy.redirects["http://127.0.0.1/a"] = "https://localhost/b"
        assert reads("http://me:secret@127.0.0.1/a")
        assert server.logins[2:] == [None] * 2


SECRET = "http://me:secret@example.org/a b.twz?sig=secret#secret"


@pytest.mark.parametrize(
    ("url", "name"),
    [
        (SECRET, "http://example.org/a b.twz"),
        ("http://me:se/cret@example.org/a", "http://example.org/a"),
        ("http://me:se?cret@example.org/a?b", "http://example.org/a"),
        ("http://me:se#cret@example.org:80/a", "http://example.org:80/a"),
        ("http://example.org:80/a@b?c@d", "http://example.org:80/a@b"),
        ("http://[::1]/a@b", "http://[::1]/a@b"),
        ("http://[::1]:80/a?b", "http://[::1]:80/a"),
        ("s3://key:secret@bucket/a?x=secret", "s3://bucket/a"),
        (f"zip://a.twz::{SECRET}", "zip://a.twz::http://example.org/a b.twz"),
        (f"simplecache::zip://b::{SECRET}", "simplecache::zip://b::http://example.org/a b.twz"),
        ("zip://a.twz::http://me:secret@[::1]:80/z?s", "zip://a.twz::http://[::1]:80/z"),
    ],
)
def test_names_in_messages_have_no_secrets(url, name):
    assert display_name(url) == name


def test_messages_of_other_libraries_have_no_secrets():
    text = "403, message='no', url='https://me:secret@host/a?sig=secret' (s3://k:secret@b/c)"
    assert without_secrets(text) == "403, message='no', url='https://host/a' (s3://b/c)"


def test_no_error_of_a_url_with_secrets_tells_them(server, monkeypatch):
    secret = server.url.replace("//", "//me:secret@") + "/a?sig=secret"
    server.statuses["/a?sig=secret"] = 403
    assert "secret" not in problem(secret)
    server.statuses.clear()
    server.redirects["/a?sig=secret"] = "ftp://me:secret@host/a?sig=secret"
    assert "secret" not in problem(secret)
    assert "secret" not in problem(secret.replace(server.place, "127.0.0.1:1"))
    assert "secret" not in problem(f"zip://b::{secret}")
    assert "secret" not in problem("http://me:secret@127.0.0.1:port/a?sig=secret")
    for bare in "/?#":
        assert "%2F" in problem(f"http://me:sec{bare}ret@127.0.0.1/a")
        assert "sec" not in problem(f"http://me:sec{bare}ret@127.0.0.1/a")
    monkeypatch.setenv("http_proxy", "http://me:secret@127.0.0.1:1")
    assert "secret" not in problem(secret)


@pytest.mark.parametrize("login", ["me:secret", "m é:p@ss:wörd/山", "only", "empty:"])
def test_a_proxy_with_a_login_is_used(monkeypatch, proxy, login):
    user, colon, password = login.partition(":")
    proxy.proxy_login = login if colon else login + ":"
    quoted = colon.join(
        "".join(f"%{byte:02X}" for byte in part.encode()) for part in (user, password)
    )
    monkeypatch.setenv("http_proxy", f"http://{quoted}@{proxy.place}")
    assert reads("http://example.invalid/a b")
    assert proxy.asked == ["http://example.invalid/a%20b"] * 2
    assert proxy.logins == [None] * 2


def test_a_proxy_with_a_login_makes_a_tunnel_for_https(monkeypatch, proxy):
    proxy.proxy_login = "me:se@cret"
    monkeypatch.setenv("SSL_CERT_FILE", str(AUTHORITY))
    monkeypatch.setenv("https_proxy", f"me:se%40cret@{proxy.place}")
    with serving(tls=True) as server:
        assert reads(server.url.replace("//", "//you:other@") + "/a")
        assert proxy.asked == [server.place]
        assert server.logins == ["Basic " + base64.b64encode(b"you:other").decode()] * 2


@pytest.mark.parametrize("scheme", ["http", "https"])
@pytest.mark.parametrize(
    ("login", "message"),
    [
        ("", "wants a user and password"),
        ("me:hidden@", "refuses the user and password given"),
    ],
)
def test_a_proxy_that_wants_another_login_is_named_with_what_to_do(
    monkeypatch, proxy, scheme, login, message
):
    proxy.proxy_login = "me:secret"
    monkeypatch.setenv(f"{scheme}_proxy", f"http://{login}{proxy.place}")
    found = problem(f"{scheme}://example.invalid/a")
    assert found == (
        f"cannot read {scheme}://example.invalid/a: the proxy http://{proxy.place} {message} (407"
        f" Proxy Authentication Required); name them in {scheme}_proxy, as"
        " http://user:password@host:port"
    )
    assert len(proxy.asked) == 1  # asking again does not help


def test_a_socks_proxy_is_used(monkeypatch, server):
    """RFC 1928, with user and password by RFC 1929."""
    asked = []

    def serve_one(listener):
        client, _ = listener.accept()
        with client:
            client.recv(2 + client.recv(2, socket.MSG_PEEK)[1])
            client.sendall(b"\x05\x02")
            asked.append(client.recv(100))
            client.sendall(b"\x01\x00")
            head = client.recv(5)
            host = client.recv(head[4])
            asked.append((head[:4], host, int.from_bytes(client.recv(2), "big")))
            client.sendall(b"\x05\x00\x00\x01" + bytes(6))
            with socket.create_connection(("127.0.0.1", server.server_port)) as other:
                pump(client, other)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve_one, args=(listener,))
        thread.start()
        monkeypatch.setenv("all_proxy", f"socks5h://me:pw@127.0.0.1:{listener.getsockname()[1]}")
        assert reads("http://example.invalid/a")
        thread.join()
    assert asked == [b"\x01\x02me\x02pw", (b"\x05\x01\x00\x03", b"example.invalid", 80)]
    assert server.asked == ["/a", "/a"]


@pytest.mark.parametrize(
    ("no_proxy", "host"),
    [
        ("127.0.0.1", "127.0.0.1"),
        ("elsewhere, 127.0.0.1:PORT", "127.0.0.1"),
        ("127.0.0.0/8", "127.0.0.1"),
        ("*", "127.0.0.1"),
        ("localhost", "localhost"),
        (".LOCALHOST", "localhost"),
        ("::1", "::1"),
        ("[::1]", "::1"),
        ("[::1]:PORT", "::1"),
        ("::/64", "::1"),
    ],
)
def test_no_proxy_is_obeyed(monkeypatch, proxy, no_proxy, host):
    monkeypatch.setenv("http_proxy", proxy.url)
    with serving(host="127.0.0.1" if host == "localhost" else host) as server:
        monkeypatch.setenv("no_proxy", no_proxy.replace("PORT", str(server.server_port)))
        name = f"[{host}]" if ":" in host else host
        assert reads(f"http://{name}:{server.server_port}/a")
    assert proxy.asked == []


@pytest.mark.parametrize("name", ["REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "SSL_CERT_FILE"])
def test_certificates_that_the_environment_names_are_trusted(monkeypatch, name):
    with serving(tls=True) as server:
        assert "SSL_CERT_FILE" in problem(server.url + "/a")  # says what to do
        monkeypatch.setenv(name, str(AUTHORITY))
        assert reads(server.url + "/a")


def test_a_certificate_of_another_host_is_refused_at_once(monkeypatch, proxy):
    monkeypatch.setenv("SSL_CERT_FILE", str(AUTHORITY))
    with serving(tls=True) as server:
        monkeypatch.setattr(
            socket, "getaddrinfo",
            lambda *_, **__: [(socket.AF_INET, socket.SOCK_STREAM, 6, "", server.server_address)],
        )  # fmt: skip
        found = problem(f"https://other.example:{server.server_port}/a")
        assert "other.example" in found
        assert "certificate" in found
        assert server.asked == []


@pytest.mark.parametrize("n_times", [1, 3])
def test_a_connection_that_is_reset_amid_a_body_is_replaced(server, n_times):
    server.resets = n_times
    assert reads(server.url + "/a")
    assert len(server.asked) == 2 + n_times


def test_many_threads_share_sixteen_connections(server, caplog):
    source = open_source(server.url + "/a")
    with ThreadPoolExecutor(40) as pool:
        reads = [pool.submit(source.read, 20_000 + i, 100) for i in range(200)]
        assert all(one.result() == DATA[20_000 + i :][:100] for i, one in enumerate(reads))
    source.close()
    assert len(server.asked) == 201
    assert len(server.clients) <= 16
    assert caplog.text == ""


def test_closing_ends_threads_that_wait_for_their_turn(monkeypatch):
    monkeypatch.setattr(module, "TIMEOUT", 3600)
    with socket.create_server(("127.0.0.1", 0), backlog=64) as listener, serving() as server:
        source = open_source(server.url + "/a")
        server.redirects["/a"] = f"http://127.0.0.1:{listener.getsockname()[1]}/silent"
        with ThreadPoolExecutor(40) as pool:
            reads = [pool.submit(source.read, 20_000, 100) for _ in range(40)]
            assert select.select([listener], [], [], 30)[0]
            source.close()
            still_waiting = wait(reads, timeout=60).not_done
            listener.close()  # ends those, too
        assert not still_waiting
        assert {str(one.exception()) for one in reads} == {f"{server.url}/a is closed"}


class DrippingHandler(Handler):
    """Sends a byte now and then, of the headers or of the body."""

    in_headers = False

    def do_GET(self):
        self.close_connection = True
        head = b"HTTP/1.1 206 Partial Content\r\nContent-Length: 100\r\n"
        head += b"Content-Range: bytes 0-99/100\r\n"
        self.wfile.write(head if self.in_headers else head + b"\r\n")
        for number in range(100):
            try:
                self.wfile.write(b"X: %d\r\n" % number if self.in_headers else b"x")
            except OSError:
                return
            time.sleep(0.05)


@pytest.mark.parametrize("in_headers", [False, True])
def test_a_server_that_drips_has_a_limit_for_all_of_a_reply(monkeypatch, in_headers):
    monkeypatch.setattr(module, "TIMEOUT", 0.4)
    monkeypatch.setattr(module, "LEAST_RATE", 1e9)
    handler = type("Dripping", (DrippingHandler,), {"in_headers": in_headers})
    with serving(handler=handler) as server:
        began = time.monotonic()
        with pytest.raises(SourceUnavailableError, match="has not sent 16,384 bytes in 0 s; try"):
            open_source(server.url)
    assert time.monotonic() - began < 3


def test_a_proxy_without_an_address_is_one_clear_line(monkeypatch):
    for proxy in ("http://[::1", "gopher://127.0.0.1:1", "http://a:b"):
        monkeypatch.setenv("http_proxy", proxy)
        assert "expected http://host:port" in problem("http://example.invalid/a")


@pytest.mark.parametrize("name", ["REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "SSL_CERT_FILE"])
@pytest.mark.parametrize("content", [None, b"", b"no certificate"])
def test_a_variable_that_names_no_certificates_is_named(monkeypatch, tmp_path, name, content):
    path = tmp_path / "ca.pem"
    if content is not None:
        path.write_bytes(content)
    monkeypatch.setenv(name, str(path))
    found = problem("https://127.0.0.1:1/a")
    assert found.startswith(f"{name} is {path}: found no certificates there")


@pytest.mark.parametrize(("status", "n_asked"), [(403, 1), (503, 3)])
def test_a_proxy_that_makes_no_tunnel_is_named(monkeypatch, proxy, status, n_asked):
    proxy.tunnel_status = status
    monkeypatch.setenv("https_proxy", proxy.url)
    with pytest.raises(StorageError, match=f"the proxy {proxy.url} answers {status}") as caught:
        open_source("https://example.invalid/a")
    assert len(proxy.asked) == n_asked
    assert isinstance(caught.value, SourceUnavailableError) == (status == 503)
