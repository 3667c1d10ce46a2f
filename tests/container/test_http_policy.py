"""What web servers answer, case by case: the table that both readers are held to.

`tests/http_cases.json` says what each field means; js/test/url.test.js reads it, too.
"""

import gzip
import json
import re
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from servers import running

from terrainwave.container.sources import url as module
from terrainwave.container.sources.opening import open_source
from terrainwave.errors import StorageError, TerrainwaveError

TABLE = json.loads((Path(__file__).parents[1] / "http_cases.json").read_text(encoding="utf-8"))
POLICY = TABLE["policy"]
DATA = bytes(i * 7 % 251 for i in range(40_000))
WHERE, LENGTH = 30_000, 100


class Handler(BaseHTTPRequestHandler):
    """Gives the replies of a case, one after the other."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self):
        owner = self.server
        owner.asked.append(self)
        replies = owner.replies
        reply = replies.pop(0) if len(replies) > 1 else replies[0]
        headers = {name: in_dates(value) for name, value in reply.get("headers", {}).items()}
        if_match = self.headers.get("If-Match")
        if reply.get("if_match") and if_match not in (None, headers["ETag"]):
            replies[0] = reply
            return self.send(412, b"", {})
        if reply.get("hang_up"):
            self.close_connection = True
            return None
        if reply.get("stall"):
            owner.woken.wait(10)
            self.close_connection = True
            return None
        status = reply.get("status", 206)
        body = reply.get("text", "").encode()
        if status == 200:
            body = gzip.compress(DATA) if reply.get("gzip") else DATA
            headers |= {"Content-Encoding": "gzip"} if reply.get("gzip") else {}
        if status == 206:
            wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers["Range"])
            first, last = int(wanted[1]), min(int(wanted[2]), len(DATA) - 1)
            body = DATA[first : last + 1]
            if not reply.get("bare"):
                place = f"bytes {first}-{last}/{len(DATA)}"
                headers["Content-Range"] = reply.get("range", place)
        body = body[: len(body) - reply.get("short", 0)]
        length = None if reply.get("no_length") else len(body)
        return self.send(status, body[: reply.get("cut", len(body))], headers, length)

    def send(self, status, body, headers, length=0):
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()
        self.wfile.write(body)
        self.close_connection = length != len(body)

    def log_message(self, *_):
        pass


def in_dates(value):
    """Return a header, a date where it is seconds from now."""
    seconds = re.fullmatch(r"([+-]\d+)s", value)
    return formatdate(time.time() + int(seconds[1]), usegmt=True) if seconds else value


@contextmanager
def serving(replies):
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.replies, server.asked, server.woken = list(replies), [], threading.Event()
    server.handle_error = lambda *_: None
    with running(server):
        yield server, f"http://127.0.0.1:{server.server_port}"
        server.woken.set()


@pytest.fixture
def waits(monkeypatch):
    """Return the seconds that were waited for, which take none."""
    found = []
    monkeypatch.setattr(module.HttpSource, "_wait", lambda _, seconds: found.append(seconds))
    monkeypatch.setattr(module, "TIMEOUT", 0.3)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return found


def outcome(address):
    """Return the bytes, or the message; and whether the error may pass."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of files that come whole
        try:
            source = open_source(address)
            try:
                return source.read(WHERE, LENGTH)
            finally:
                source.close()
        except TerrainwaveError as error:
            return str(error)


def check(case, waits):
    with serving(case["replies"]) as (server, host):
        address = f"{host}/dir/a.twz"
        login = f"{case['login']}@" if "login" in case else ""
        asked = address.replace("://", f"://{login}") + case.get("query", "")
        found = outcome(asked)
        n_requests = len(server.asked)
    expected = case.get("error", "").replace("NAME", address)
    if not expected:
        assert found == DATA[WHERE : WHERE + LENGTH]
    elif expected.endswith("…"):
        assert isinstance(found, str)
        assert found.startswith(expected[:-1])
    else:
        assert found == expected
    assert waits == pytest.approx(case["waits"], abs=case.get("within", 0))
    assert n_requests == case.get("requests", n_requests)


@pytest.mark.parametrize("case", TABLE["cases"], ids=lambda case: case["name"])
def test_a_case_of_the_table(case, waits):
    check(case, waits)


@pytest.mark.parametrize(("status", "words"), POLICY["retried"].items())
def test_a_server_that_may_have_time_later_is_asked_three_times(status, words, waits):
    reply = {"status": int(status)}
    check({"replies": [reply, {}], "requests": 3, "waits": [0.2]}, waits)
    waits.clear()
    error = f"cannot read NAME: HTTP status {status} {words}"
    check({"replies": [reply], "requests": 3, "waits": POLICY["delays"], "error": error}, waits)
    waits.clear()
    # While reading: the opening, and three more.
    check({"replies": [{}, reply], "requests": 4, "waits": [0.2, 1.0], "error": error}, waits)


@pytest.mark.parametrize(("status", "words"), POLICY["final"].items())
def test_a_server_that_refuses_is_asked_once(status, words, waits):
    error = f"cannot read NAME: HTTP status {status} {words}"
    check({"replies": [{"status": int(status)}], "requests": 1, "waits": [], "error": error}, waits)


def test_a_whole_file_in_a_coding_that_is_not_known_is_refused(waits):
    reply = {"status": 200, "headers": {"Content-Encoding": "zstd"}}
    error = (
        "NAME: the server sends the file with Content-Encoding: zstd, which cannot be decoded here;"
        " store the file there without it"
    )
    check({"replies": [reply], "requests": 1, "waits": [], "error": error}, waits)


def test_parts_are_asked_for_uncompressed(waits):
    with serving([{}]) as (server, host):
        outcome(host + "/a")
        assert {request.headers["Accept-Encoding"] for request in server.asked} == {"identity"}


def test_the_numbers_are_those_of_the_table():
    assert {str(status) for status in module._BUSY} == set(POLICY["retried"])
    assert list(module._DELAYS) == POLICY["delays"]
    assert POLICY["longest_wait"] == module.MAX_WAIT
    assert POLICY["silence"] == module.TIMEOUT
    assert POLICY["least_rate"] == module.LEAST_RATE
    assert POLICY["whole_mib"] << 20 == module.MAX_WHOLE


def test_waiting_ends_when_the_file_is_closed(monkeypatch):
    monkeypatch.setattr(module, "_DELAYS", (30.0, 30.0))

    class Closing(threading.Event):
        """The source's event, which says when the source waits and what ended that."""

        is_waited_for, answers = threading.Event(), []

        def wait(self, timeout=None):
            self.is_waited_for.set()
            self.answers.append(super().wait(timeout))
            return self.answers[-1]

    with serving([{}, {"status": 503}]) as (server, host), ThreadPoolExecutor(1) as pool:
        source = open_source(host + "/a")
        source._closing = Closing()
        reading = pool.submit(source.read, WHERE, LENGTH)
        assert Closing.is_waited_for.wait(30)
        source.close()
        with pytest.raises(StorageError, match="is closed"):
            reading.result(60)
        assert Closing.answers == [True]  # not the 30 seconds
        assert len(server.asked) == 2
