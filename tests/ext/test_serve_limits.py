"""What `terrainwave serve` refuses, ends or does not say: limits against hostile clients."""

import asyncio
import logging
import os
import select
import socket
import threading
from unittest.mock import Mock

import pytest
from commands import one_line, run
from ext.browser import served
from ext.rasters import BOUNDS, hills, write_twz
from fastapi.testclient import TestClient

from terrainwave.errors import CorruptStreamError
from terrainwave.ext.serve import client_limits
from terrainwave.ext.serve.app import make_app
from terrainwave.ext.serve.log import warn_once
from terrainwave.globe import terrain_rgb as tiling

REQUEST = b"GET /terrains.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


@pytest.fixture
def client(hilly):
    app = make_app([str(hilly)])
    with TestClient(app, "http://127.0.0.1", raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def quick(monkeypatch):
    """Let a third of a second be too long."""
    for name in ("ASK_SECONDS", "TAKE_SECONDS"):
        monkeypatch.setattr(client_limits, name, 0.3)
    monkeypatch.setattr(client_limits, "_LOOK_SECONDS", 0.05)


@pytest.fixture
def address(hilly):
    with served(make_app([str(hilly)])) as url:
        host, port = url.removeprefix("http://").split(":")
        yield host, int(port)


def connected(address):
    found = socket.create_connection(address, timeout=10)
    found.settimeout(10)
    return found


def is_ended(client):
    """Say whether the server ends a connection, in ten seconds; what it sends is dropped."""
    try:
        while client.recv(1 << 16):
            pass
    except ConnectionError:
        return True
    except TimeoutError:
        return False
    return True


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("sent", [b"", REQUEST[:-2], REQUEST + REQUEST[:9]])
def test_who_does_not_ask_to_the_end_is_cut_off(address, sent):
    with connected(address) as client:
        client.sendall(sent)
        assert is_ended(client)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("drop", [b"a: b\r\n", b"x"])
def test_a_request_in_drops_is_cut_off(address, drop):
    """Headers, or the body of a request that is answered, a few bytes at a time."""
    head = REQUEST[:-2] if drop != b"x" else REQUEST[:-2] + b"Content-Length: 9999\r\n\r\n"
    with connected(address) as client:
        client.sendall(head)
        with pytest.raises(ConnectionError):  # noqa: PT012 - which of the sends fails is open
            for _ in range(3000):  # a minute of them, if nobody ends it
                client.sendall(drop)
                select.select([], [], [client], 0.02)


def test_a_body_that_does_not_come_is_given_up(client, monkeypatch):
    """A client sends the head of a request, and never its body."""
    monkeypatch.setattr(client_limits, "ASK_SECONDS", 0.05)

    async def ask():
        sent = []

        async def receive():
            await asyncio.Event().wait()

        async def send(message):
            sent.append(message)

        headers = [(b"host", b"127.0.0.1"), (b"content-length", b"9")]
        scope = {
            "type": "http", "method": "POST", "path": "/hills/height", "raw_path": b"/hills/height",
            "query_string": b"", "headers": headers, "http_version": "1.1", "scheme": "http",
            "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 80), "root_path": "", "state": {},
        }  # fmt: skip
        await client.app(scope, receive, send)
        return sent

    assert asyncio.run(ask())[0]["status"] == 408


async def large(scope, receive, send):
    """Answer more than sockets hold, at once."""
    if scope["type"] == "http":
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": bytes(32 << 20)})


@pytest.mark.usefixtures("quick")
def test_who_does_not_take_an_answer_is_cut_off():
    with served(large) as url, connected(_place(url)) as client:
        client.sendall(REQUEST)
        ends = select.poll()
        ends.register(client, select.POLLHUP | select.POLLERR)
        assert ends.poll(10_000)


@pytest.mark.usefixtures("quick")
def test_work_that_takes_long_is_no_slow_client(hilly, monkeypatch):
    """The work ends when the server has looked at the connection past twice the time."""
    look_at, is_late = client_limits.Connection._look_at, threading.Event()

    def look(self):
        self.began = getattr(self, "began", self.loop.time())
        look_at(self)
        if self.loop.time() - self.began > 2 * client_limits.ASK_SECONDS:
            is_late.set()

    def work(*_):
        assert is_late.wait(60)

    monkeypatch.setattr(client_limits.Connection, "_look_at", look)
    monkeypatch.setattr(tiling, "rgb_tile", work)
    with served(make_app([str(hilly)])) as url, connected(_place(url)) as client:
        client.sendall(REQUEST.replace(b"terrains.json", b"hills/rgb/0/0/0.png"))
        assert client.recv(100).startswith(b"HTTP/1.1 204 ")


def _place(url):
    host, port = url.removeprefix("http://").split(":")
    return host, int(port)


def told_of(monkeypatch, name):
    """Return a semaphore that is released after each call of a method of connections."""
    method, calls = getattr(client_limits.Connection, name), threading.Semaphore(0)

    def told(self, *args):
        method(self, *args)
        calls.release()

    monkeypatch.setattr(client_limits.Connection, name, told)
    return calls


def test_more_connections_than_allowed_are_refused_at_once(hilly, monkeypatch):
    monkeypatch.setattr(client_limits, "MAX_CONNECTIONS", 2)
    made, lost = (told_of(monkeypatch, name) for name in ("connection_made", "connection_lost"))
    with served(make_app([str(hilly)])) as url:
        held = [connected(_place(url)) for _ in range(2)]
        for _ in held:
            assert made.acquire(timeout=60)
        with connected(_place(url)) as one_more:
            assert one_more.recv(100).startswith(b"HTTP/1.1 503 ")
            assert is_ended(one_more)
        assert lost.acquire(timeout=60)
        held.pop().close()
        assert lost.acquire(timeout=60)
        with connected(_place(url)) as later:
            later.sendall(REQUEST)
            assert later.recv(100).startswith(b"HTTP/1.1 200 ")
        held.pop().close()


@pytest.mark.parametrize(
    "request_",
    [
        REQUEST.replace(b"Host: 127.0.0.1\r\n", b""),
        REQUEST.replace(b"Host: 127.0.0.1", b"Host: 127.0.0.1\r\nHost: 127.0.0.1"),
        REQUEST.replace(b"Host: 127.0.0.1", b"Host: 127.0.0.1/evil"),
        REQUEST.replace(b"Host: 127.0.0.1", b"Host: 127.0.0.1.evil.example"),
        b"\0\1\2\r\n\r\n",
        REQUEST.replace(b"/terrains", b"/\xff"),
    ],
    ids=["no host", "two hosts", "path", "suffix", "binary", "latin"],
)
def test_what_is_no_request_is_refused_without_a_line_in_the_log(address, request_, caplog):
    with connected(address) as client:
        client.sendall(request_)
        assert client.recv(100).startswith(b"HTTP/1.1 400 ")
    assert not caplog.messages


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/", 200), ("GET", "/none.tif", 404), ("POST", "/hills.twz", 405),
        ("GET", "/hills/rgb/0/0/0.png", 500), ("GET", "/static/page.js", 200),
    ],
)  # fmt: skip
def test_every_answer_says_what_a_page_may_do_with_it(client, monkeypatch, method, path, status):
    monkeypatch.setattr(tiling, "rgb_tile", None)
    answer = client.request(method, path)
    assert answer.status_code == status
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert "frame-ancestors 'self'" in answer.headers["content-security-policy"]
    assert answer.headers["cross-origin-resource-policy"] == "same-origin"


@pytest.fixture
def told(caplog):
    """Return a function for the lines of the log of a server that begins."""
    warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        yield lambda: caplog.messages


def test_neither_a_path_nor_an_error_breaks_a_line_of_the_log(client, monkeypatch, told):
    monkeypatch.setattr(tiling, "rgb_tile", Mock(side_effect=CorruptStreamError("no\nsuch")))
    assert client.get("/hills/rgb/%0A0/0/0.png").status_code == 500
    assert told() == ["hills: no such"]


def test_a_defect_is_logged_and_what_clients_cause_is_not():
    for level, is_logged in ((logging.ERROR, True), (logging.WARNING, False)):
        record = logging.LogRecord("x", level, "x", 1, "Invalid request", (), None)
        assert client_limits._is_logged(record) == is_logged


def test_a_file_that_is_replaced_is_read_on_and_one_that_is_cut_is_a_line(tmp_path):
    path = write_twz(tmp_path, hills(65, 97), BOUNDS)
    data = path.read_bytes()
    with TestClient(make_app([str(path)]), "http://127.0.0.1") as client:
        path.rename(tmp_path / "old.twz")
        path.write_bytes(b"something else")
        assert client.get("/hills.twz").content == data
        with open(tmp_path / "old.twz", "r+b") as file:
            file.truncate(200)
        answer = client.get("/hills.twz")
    assert answer.status_code == 500
    assert answer.json() == {"detail": "the file cannot be read there"}


def test_a_file_that_takes_the_place_of_another_has_another_tag(tmp_path):
    """It may have the same size and header: a browser must not mix tiles of the two."""
    path = write_twz(tmp_path, hills(65, 97), BOUNDS)

    def tag_and_status(known):
        with TestClient(make_app([str(path)]), "http://127.0.0.1") as client:
            told = {"If-None-Match": known}
            status = client.get("/hills/rgb/9/268/181.png", headers=told).status_code
            return client.get("/hills.twz").headers["ETag"], status

    tag, _ = tag_and_status("")
    assert tag_and_status(tag) == (tag, 304)
    os.utime(path, (1, 1))
    other, status = tag_and_status(tag)
    assert other != tag
    assert status == 200


@pytest.mark.parametrize("name", ["a b", "*x", "http://a", "a:80", ""])
def test_what_is_no_host_name_is_wrong_usage(hilly, name):
    assert "host name" in one_line(run("serve", hilly, "--allow-host", name, "--port", "0"), 2)
