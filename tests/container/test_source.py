"""Byte sources of files and buffers: exact ranges, few requests, clear errors."""

import io
import os
import pickle
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.container.source import (
    MAX_GAP,
    MAX_REQUEST,
    BufferSource,
    ByteRange,
    FileSource,
    merge_ranges,
    open_source,
)
from terrainwave.errors import StorageError, TruncatedStreamError

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


@pytest.mark.parametrize(
    "wanted", [(len(DATA), 1), (0, len(DATA) + 1), (-1, 1), (0, -1), (2**62, 2**62)]
)
def test_a_range_outside_is_truncated(source, wanted):
    with pytest.raises(TruncatedStreamError, match="bytes"):
        source.read(*wanted)
    with pytest.raises(TruncatedStreamError, match="bytes"):
        source.read_many([ByteRange(*wanted)])


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

    threads = [threading.Thread(target=work, args=(start,)) for start in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
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
    with pytest.raises(StorageError, match="cannot read"):
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


def test_a_file_object_stays_open_when_its_source_is_closed():
    file = io.BytesIO(DATA)
    open_source(file).close()
    assert not file.closed


def test_a_file_url_is_a_path(tmp_path):
    path = tmp_path / "a b"
    path.write_bytes(DATA)
    source = open_source(path.as_uri())
    assert source.read(0, 3) == DATA[:3]
    source.close()


def test_a_source_is_taken_as_it_is():
    source = BufferSource(DATA)
    assert open_source(source) is source


def test_other_things_are_no_source():
    with pytest.raises(StorageError, match="int"):
        open_source(3)


class Unseekable(io.RawIOBase):
    """As a pipe."""

    def seek(self, *_):
        raise io.UnsupportedOperation("seek")


def test_a_pipe_is_no_source():
    with pytest.raises(StorageError, match="cannot seek"):
        open_source(Unseekable())


def spans_of(ranges):
    return [span for span, _ in merge_ranges(ranges)]


def test_gaps_of_64_kib_in_all_are_bridged_and_more_are_not():
    first, second = ByteRange(0, 10), ByteRange(10 + 65536, 5)
    assert spans_of([first, second]) == [ByteRange(0, 65536 + 15)]
    assert spans_of([first, ByteRange(11 + 65536, 5)]) == [first, ByteRange(11 + 65536, 5)]
    third = ByteRange(second.end + 100, 5)  # the shorter gap is bridged
    assert spans_of([first, second, third]) == [first, ByteRange(second.offset, 110)]


def test_a_quarter_of_what_is_wanted_may_lie_in_gaps():
    mib = 2**20
    first = ByteRange(0, mib)
    near, far = ByteRange(mib + 300_000, mib), ByteRange(mib + 600_000, mib)
    assert spans_of([first, near]) == [ByteRange(0, 2 * mib + 300_000)]
    assert spans_of([first, far]) == [first, far]
    # However much is wanted, a gap above 512 KiB costs more than a request.
    large, beyond = ByteRange(0, 8 * mib), ByteRange(8 * mib + MAX_GAP + 1, mib)
    assert spans_of([large, beyond]) == [large, beyond]


def test_empty_ranges_need_no_request():
    assert spans_of([ByteRange(5, 0), ByteRange(90, 0)]) == []


ranges = st.builds(ByteRange, st.integers(0, 2**27), st.integers(0, 2**24))


@given(st.lists(ranges, max_size=30))
def test_requests_cover_each_range_once_and_stay_below_16_mib(wanted):
    merged = merge_ranges(wanted)
    filled = [number for number, member in enumerate(wanted) if member.length]
    assert sorted(n for _, members in merged for n in members) == filled
    for span, members in merged:
        for member in members:
            assert span.offset <= wanted[member].offset
            assert wanted[member].end <= span.end
        assert span.length <= MAX_REQUEST or len(members) == 1
