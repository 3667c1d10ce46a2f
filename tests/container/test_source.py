"""Byte sources of files and buffers: exact ranges, few requests, clear errors."""

import io
import os
import pickle
from concurrent.futures import ThreadPoolExecutor

import pytest

from terrainwave.container.sources.byte_source import BufferSource, FileSource
from terrainwave.container.sources.opening import open_source
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.errors import InvalidArgumentError, StorageError, TruncatedStreamError

DATA = bytes(range(256)) * 40


@pytest.fixture(params=["file", "file without pread", "bytes", "file object"])
def source(request, tmp_path, monkeypatch):
    path = tmp_path / "data"
    path.write_bytes(DATA)
    if request.param == "file without pread":
        monkeypatch.delattr(os, "pread", raising=False)
    with open(path, "rb") as file:
        opened = open_source(
            {"bytes": DATA, "file object": file}.get(request.param, os.fspath(path))
        )
        yield opened
        opened.close()


def test_ranges_are_read_exactly(source):
    assert source.size == len(DATA)
    assert source.read(10, 20) == DATA[10:30]
    assert source.read(0, len(DATA)) == DATA
    assert source.read(len(DATA), 0) == b""


def test_many_ranges_come_in_the_order_asked(source):
    ranges = [ByteRange(500, 5), ByteRange(0, 0), ByteRange(3, 4), ByteRange(500, 5)]
    assert source.read_many(ranges) == [DATA[500:505], b"", DATA[3:7], DATA[500:505]]
    assert source.read_many([]) == []
    assert source.read_spans(ranges) == source.read_many(ranges)
    assert source.read_spans([]) == []


@pytest.mark.parametrize(
    "wanted", [(len(DATA), 1), (0, len(DATA) + 1), (-1, 1), (0, -1), (2**62, 2**62)]
)
def test_a_range_outside_is_truncated(source, wanted):
    with pytest.raises(TruncatedStreamError, match="bytes"):
        source.read(*wanted)
    with pytest.raises(TruncatedStreamError, match="bytes"):
        source.read_many([ByteRange(*wanted)])
    with pytest.raises(TruncatedStreamError, match="bytes"):
        source.read_spans([ByteRange(*wanted)])


def test_reading_a_closed_source_is_a_storage_error(source):
    source.close()
    with pytest.raises(StorageError, match="closed"):
        source.read(0, 1)


def test_threads_do_not_disturb_each_other(source):
    wrong = []

    def work(start):
        for offset in range(start, len(DATA) - 50, 97):
            if source.read(offset, 50) != DATA[offset : offset + 50]:
                wrong.append(offset)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(8)))
    assert not wrong


def test_a_file_that_shrinks_while_open_is_truncated(tmp_path):
    path = tmp_path / "data"
    path.write_bytes(DATA)
    source = FileSource(path)
    os.truncate(path, 100)
    with pytest.raises(TruncatedStreamError, match="ends at byte 100"):
        source.read(90, 20)
    source.close()


@pytest.mark.parametrize("name", ["missing", "."])
def test_a_path_that_is_no_file_is_a_storage_error(tmp_path, name):
    with pytest.raises(StorageError, match=r"cannot read|is a directory; expected a \.twz file"):
        open_source(tmp_path / name).read(0, 1)


def test_a_pickled_file_source_opens_its_path_again(tmp_path, monkeypatch):
    (tmp_path / "data").write_bytes(DATA)
    monkeypatch.chdir(tmp_path)
    source = FileSource("data")
    pickled = pickle.dumps(source)
    source.close()
    monkeypatch.chdir("/")
    copy = pickle.loads(pickled)
    assert copy.read(1, 2) == DATA[1:3]
    copy.close()


def test_bytes_can_be_pickled_and_a_file_object_cannot():
    assert pickle.loads(pickle.dumps(BufferSource(DATA))).read(1, 2) == DATA[1:3]
    with pytest.raises(TypeError, match="cannot be pickled"):
        pickle.dumps(BufferSource(io.BytesIO(DATA)))


def test_a_file_url_is_a_path(tmp_path):
    path = tmp_path / "a b"
    path.write_bytes(DATA)
    source = open_source(path.as_uri())
    assert source.read(0, 3) == DATA[:3]
    source.close()


def test_other_things_are_no_source():
    with pytest.raises(InvalidArgumentError, match=r"^found 3, expected the path or URL"):
        open_source(3)


class Unseekable(io.RawIOBase):
    """As a pipe."""

    def seek(self, *_):
        raise io.UnsupportedOperation("seek")


def test_a_pipe_is_no_source():
    with pytest.raises(StorageError, match="cannot seek"):
        open_source(Unseekable())


def version_of(path):
    source = FileSource(path)
    try:
        return source.version
    finally:
        source.close()


def test_a_file_in_the_place_of_another_has_another_version(tmp_path):
    """Also of the same size and time, as tools that keep times leave it."""
    path, other = tmp_path / "a.twz", tmp_path / "b.twz"
    path.write_bytes(b"before")
    other.write_bytes(b"behind")
    times = (1_700_000_000, 1_700_000_000)
    os.utime(path, times)
    first = version_of(path)
    assert first == version_of(path)
    os.replace(other, path)
    os.utime(path, times)
    second = version_of(path)
    path.write_bytes(b"anew..")  # in place
    os.utime(path, times)
    assert len({first, second, version_of(path)}) == 3
