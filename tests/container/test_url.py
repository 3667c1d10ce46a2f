"""URLs: a local web server counts requests and bytes and misbehaves on demand."""

import os
import pickle
import re
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from unittest.mock import Mock

import numpy as np
import pytest
from container.toys import forge, toy_file, toy_header, toy_payload
from containers import open_container
from forks import holds_in_a_fork
from servers import running

from terrainwave.container.page import empty_page, page_layout
from terrainwave.container.sources.opening import open_source
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.errors import (
    StorageError,
    TerrainwaveWarning,
    TruncatedStreamError,
)
from terrainwave.grid.quadtree import Block

BIG = 64 * 2**20


class Handler(BaseHTTPRequestHandler):
    """Serves ``server.files`` by ranges; ``server.faults`` says what goes wrong where."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self):
        server, path = self.server, self.path.partition("?")[0]
        fault = server.faults.get(path)
        server.requests.append((path, self.headers.get("Range"), self.client_address))
        if isinstance(fault, int) and fault >= 300:
            return self.reply(fault, b"no")
        if isinstance(fault, str) and fault.startswith("->"):
            return self.reply(302, b"", Location=fault[2:])
        data = server.files.get(path)
        if data is None:
            return self.reply(404, b"not here")
        if fault == "no ranges":
            return self.reply(200, data)
        if fault == "no ranges, no length":
            self.close_connection = True
            return self.reply(200, data, has_length=False)
        first, last = map(int, re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers["Range"]).groups())
        if first >= len(data):
            return self.reply(416, b"", **{"Content-Range": f"bytes */{len(data)}"})
        body = data[first : last + 1]
        place = f"bytes {first}-{first + len(body) - 1}/{len(data)}"
        version = {"ETag": server.etags[path]} if path in server.etags else {}
        self.reply(206, body, **{"Content-Range": place}, **version)
        if fault == "closes silently":
            self.close_connection = True
        return None

    def reply(self, status, body, has_length=True, **headers):
        self.send_response(status)
        if has_length:
            self.send_header("Content-Length", str(len(body)))
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        for start in range(0, len(body), 65536):
            # Counted first: the client may look before this thread goes on.
            self.server.n_bytes += len(body[start : start + 65536])
            self.wfile.write(body[start : start + 65536])

    def log_message(self, *_):
        pass


class Server(ThreadingHTTPServer):
    """Quiet about clients that hang up."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files, self.faults, self.requests = {}, {}, []
        self.n_bytes = 0
        self.etags = {}

    def handle_error(self, *_):
        pass

    def url(self, path):
        return f"http://127.0.0.1:{self.server_port}{path}"


@pytest.fixture
def server(monkeypatch):
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with running_server() as running:
        yield running


def running_server():
    return running(Server())


def test_a_large_file_opens_with_one_request_of_16_kib(server):
    header = toy_header(5000, 5000)
    server.files["/a.twz"] = toy_file(header)
    with open_container(server.url("/a.twz")) as container:
        assert container.header == header
    assert [wanted for _, wanted, _ in server.requests] == ["bytes=0-16383"]
    assert server.n_bytes == 16384


def test_the_largest_top_page_opens_with_two_requests_and_64_kib(server):
    header = toy_header(4000, 4000)
    layout = page_layout(header.grid, None)
    assert (len(layout.keys), len(layout.blocks), len(layout.children)) == (22, 85, 64)
    page = empty_page(layout)
    rng = np.random.default_rng(1)
    page.codes[:] = rng.integers(0, 256, (85, 4))
    page.payload_lengths[:] = 1
    page.payload_crcs[:] = rng.integers(0, 2**32, 22)
    page.child_page_lengths[:] = 13
    page.child_lengths[:] = rng.integers(13, 2**16, 64)
    rest = bytes(sum(page.child_body_lengths))
    metadata = {"crs": "".join(chr(code) for code in rng.integers(32, 126, 20_000))}
    server.files["/a.twz"] = forge(toy_header(4000, 4000, metadata=metadata), page, bytes(22), rest)
    with open_container(server.url("/a.twz")) as container:
        assert len(container.segment(None).layout.children) == 64
    assert len(server.requests) == 2
    assert 16384 < server.n_bytes <= 65536


def test_payloads_over_http_are_those_of_the_file(server):
    header = toy_header(2000, 1999)
    server.files["/a.twz"] = toy_file(header)
    keys = header.grid.blocks(5)
    with open_container(server.url("/a.twz")) as container:
        assert container.payloads(keys) == [toy_payload(key) for key in keys]
        n_requests = len(server.requests)
        assert list(container.check()) == []
    assert n_requests <= 3  # open, sixteen pages in one, payloads in one


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_fork_reads_on_connections_of_its_own(server):
    server.files["/a"] = data = np.random.default_rng(1).bytes(1_000_000)
    source = open_source(server.url("/a"))
    assert holds_in_a_fork(lambda: source.read(500_000, 9) == data[500_000:500_009])
    assert source.read(600_000, 9) == data[600_000:600_009]
    parent, child, again = (address for _, _, address in server.requests)
    assert parent == again != child
    source.close()


def test_far_ranges_are_read_side_by_side_and_in_order(server):
    data = np.random.default_rng(1).bytes(6_000_000)
    server.files["/a"] = data
    source = open_source(server.url("/a"))
    ranges = [ByteRange(offset, 1000) for offset in range(5_900_000, 0, -600_000)]
    assert source.read_many(ranges) == [data[r.offset : r.end] for r in ranges]
    assert len(server.requests) == 1 + len(ranges)
    source.close()


def test_a_small_file_comes_whole_from_a_server_without_ranges(server):
    header = toy_header(500, 500)
    data = server.files["/a.twz"] = toy_file(header)
    server.faults["/a.twz"] = "no ranges"
    with pytest.warns(TerrainwaveWarning, match=f"was fetched, {len(data):,} bytes"):
        container = open_container(server.url("/a.twz"))
    with container, open_container(data) as local:
        for key in header.grid.root_keys():
            assert container.payload(key) == local.payload(key)
    assert len(server.requests) == 1


@pytest.mark.parametrize("says_length", [True, False])
def test_a_large_file_without_ranges_is_one_clear_error_and_no_download(
    server, monkeypatch, says_length
):
    if not says_length:
        monkeypatch.setattr("terrainwave.container.sources.url.MAX_WHOLE", 1 << 20)
    server.files["/a.twz"] = bytes(BIG + 1)
    server.faults["/a.twz"] = "no ranges" if says_length else "no ranges, no length"
    with pytest.raises(StorageError, match="download the file and open") as caught:
        open_container(server.url("/a.twz"))
    assert "\n" not in str(caught.value)
    assert len(server.requests) == 1
    assert server.n_bytes < BIG // 4  # what fits the sockets' buffers


def test_a_kept_connection_that_went_stale_is_replaced(server):
    server.files["/a"] = bytes(100_000)
    server.faults["/a"] = "closes silently"
    source = open_source(server.url("/a"))
    assert source.read(50_000, 10) == bytes(10)
    assert source.read(60_000, 10) == bytes(10)
    source.close()


@pytest.mark.parametrize("place", ["/a", "file:///etc/passwd", "ftp://127.0.0.1/a"])
def test_endless_and_foreign_redirects_are_refused(server, place):
    server.faults["/a"] = "->" + place
    with pytest.raises(StorageError, match="redirects"):
        open_source(server.url("/a"))


def test_a_file_replaced_by_one_of_the_same_size_is_noticed_by_a_pickled_source(server):
    server.files["/a"], server.etags["/a"] = bytes(100_000), '"1"'
    source = open_source(server.url("/a"))
    server.etags["/a"] = '"2"'
    with pytest.raises(StorageError, match="has changed"):
        pickle.loads(pickle.dumps(source))
    source.close()


def test_a_pickled_url_is_opened_again(server):
    server.files["/a.twz"] = toy_file()
    with open_container(server.url("/a.twz")) as container:
        copy = pickle.loads(pickle.dumps(container))
    assert copy.payload(Block(-1, 0, 0)) == toy_payload(Block(-1, 0, 0))
    copy.close()


def test_fsspec_reads_exact_ranges(memory):
    header = toy_header(300, 300)
    memory.pipe("/a.twz", toy_file(header))
    with open_container("memory://a.twz") as container:
        copy = pickle.loads(pickle.dumps(container))
        assert copy.header == container.header == header
        keys = header.grid.blocks(3)
        assert container.payloads(keys) == [toy_payload(key) for key in keys]
        assert list(copy.check()) == []


def test_fsspec_reads_near_ranges_in_one_request(memory, monkeypatch):
    data = np.random.default_rng(1).bytes(2_000_000)
    memory.pipe("/a", data)
    source = open_source("memory://a")
    asked = []
    cat_file = type(memory).cat_file

    def counted(self, path, start=None, end=None, **options):
        asked.append((start, end))
        return cat_file(self, path, start=start, end=end, **options)

    monkeypatch.setattr(type(memory), "cat_file", counted)
    ranges = [ByteRange(1_500_000, 10), ByteRange(0, 10), ByteRange(1000, 10)]
    assert source.read_many(ranges) == [data[r.offset : r.end] for r in ranges]
    assert sorted(asked) == [(0, 1010), (1_500_000, 1_500_010)]


def test_a_file_replaced_in_fsspec_is_noticed(memory):
    header = toy_header(2000, 2000)
    data = toy_file(header)
    memory.pipe("/a.twz", data)
    container = open_container("memory://a.twz")
    copy = pickle.dumps(container)
    memory.pipe("/a.twz", data[:20_000] + bytes(len(data) - 20_000))
    with pytest.raises(StorageError, match="has changed while it was open"):
        container.payloads(header.grid.blocks(5))
    with pytest.raises(StorageError, match="has changed"):
        pickle.loads(copy)
    memory.pipe("/a.twz", b"short")
    with pytest.raises(StorageError, match="has changed"):
        container.payloads(header.grid.blocks(5))


def test_a_file_system_that_ignores_ranges_is_noticed(memory, monkeypatch):
    memory.pipe("/a", bytes(1000))
    source = open_source("memory://a")
    monkeypatch.setattr(type(memory), "cat_file", lambda *_, **__: bytes(1000))
    with pytest.raises(StorageError, match="byte ranges"):
        source.read(5, 10)


def test_any_failure_of_a_file_system_is_a_storage_error(memory, monkeypatch):
    memory.pipe("/a", bytes(1000))
    source = open_source("memory://a")

    monkeypatch.setattr(
        type(memory),
        "cat_file",
        Mock(
            side_effect=RuntimeError(
                "no credentials for https://me:secret@host/a?sig=secret\nlong story"
            )
        ),
    )
    with pytest.raises(StorageError, match=r"no credentials for https://host/a$"):
        source.read(5, 10)


def test_an_empty_file_is_truncated(server):
    server.files["/a"] = b""
    with pytest.raises(TruncatedStreamError):
        open_container(server.url("/a"))


def test_an_expired_redirect_is_asked_for_again(server):
    server.files["/b"] = server.files["/c"] = bytes(100_000)
    server.faults["/a"] = "->/b"
    source = open_source(server.url("/a"))
    server.faults |= {"/a": "->/c", "/b": 403}
    assert source.read(50_000, 10) == bytes(10)
    source.close()


def test_a_connection_lost_in_fsspec_is_tried_again(memory, monkeypatch):
    monkeypatch.setattr("terrainwave.container.sources.url._DELAYS", (0.0, 0.0))
    memory.pipe("/a", b"abc")
    source = open_source("memory://a")
    attempts = []

    def fail(*_, **__):
        attempts.append(1)
        raise ConnectionResetError("reset by peer")

    monkeypatch.setattr(type(memory), "cat_file", fail)
    with pytest.raises(StorageError, match="reset by peer"):
        source.read(0, 3)
    assert len(attempts) == 3
