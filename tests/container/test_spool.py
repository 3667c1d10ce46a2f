"""Temporary stores of segments: any order, little memory, no files left."""

import errno
import threading

import numpy as np
import pytest

from terrainwave.container.spool import SectionFile, SegmentSpool
from terrainwave.errors import StorageError
from terrainwave.grid.quadtree import Block


def key(number):
    return Block(3, number // 10, number % 10)


def payload(number):
    return np.random.default_rng(number).bytes(1000 * (number % 40))


def filled(directory, numbers=range(60)):
    spool = SegmentSpool(SectionFile(directory))
    for number in numbers:
        spool.add(key(number), payload(number), 0, b"", payload(number)[:5])
    return spool


def test_payloads_come_back_in_the_order_asked(tmp_path):
    spool = filled(tmp_path, range(59, -1, -1))
    wanted = [key(n) for n in range(60)]
    expected = b"".join(payload(n) + payload(n)[:5] for n in range(60))
    assert b"".join(spool.chunks(wanted)) == expected


@pytest.mark.parametrize("limit", [0, 1 << 20])
def test_a_stored_segment_has_its_page_and_sections_in_order(tmp_path, monkeypatch, limit):
    monkeypatch.setattr("terrainwave.container.spool._BUFFER", limit)
    stored = filled(tmp_path).stored(b"page", [key(n) for n in range(59, -1, -1)])
    assert stored.page() == b"page"
    expected = b"".join(payload(n) + payload(n)[:5] for n in range(59, -1, -1))
    assert b"".join(stored.sections()) == expected
    assert stored.n_bytes == len(expected)


def test_few_payloads_make_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr("terrainwave.container.spool.tempfile.TemporaryFile", None)
    spool = SegmentSpool(SectionFile(tmp_path))
    spool.add(key(0), b"abc")
    assert b"".join(spool.chunks([key(0)])) == b"abc"


def test_threads_may_add_at_the_same_time(tmp_path):
    spool = SegmentSpool(SectionFile(tmp_path))

    def work(first):
        for number in range(first, 80, 8):
            spool.add(key(number), payload(number))

    threads = [threading.Thread(target=work, args=(first,)) for first in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    expected = b"".join(payload(n) for n in range(80))
    assert b"".join(spool.chunks([key(n) for n in range(80)])) == expected


def test_codes_may_come_later_and_again(tmp_path):
    spool = SegmentSpool(SectionFile(tmp_path))
    spool.add(key(1), b"")
    with pytest.raises(KeyError):
        spool.codes(key(1))
    for codes in (bytes(16), bytes(range(16))):
        spool.set_codes(key(1), codes)
    assert spool.codes(key(1)) == bytes(range(16))


def test_a_temporary_file_that_was_damaged_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr("terrainwave.container.spool._BUFFER", 0)
    file = SectionFile(tmp_path)
    spool = SegmentSpool(file)
    spool.add(key(1), b"0123456789")
    file._file.seek(5)
    file._file.write(b"x")
    with pytest.raises(StorageError, match="is damaged"):
        list(spool.chunks([key(1)]))


def no_space(*_, **__):
    raise OSError(errno.ENOSPC, "no space")


def no_space_for(file, data):
    view = memoryview(data)
    raise OSError(errno.ENOSPC, f"no space for {len(view)} bytes")


def test_a_full_temporary_disk_is_one_clear_line(tmp_path, monkeypatch):
    monkeypatch.setattr("terrainwave.container.spool.tempfile.TemporaryFile", no_space)
    monkeypatch.setattr("terrainwave.container.spool._BUFFER", 0)
    with pytest.raises(StorageError, match=r"temporary files in .*: the disk is full; free space"):
        filled(tmp_path)


def test_after_a_failed_write_the_payloads_are_still_there(tmp_path, monkeypatch):
    spool = filled(tmp_path, range(8))
    with monkeypatch.context() as failing:
        failing.setattr("terrainwave.container.spool.write_all", no_space_for)
        failing.setattr("terrainwave.container.spool._BUFFER", 0)
        with pytest.raises(StorageError) as error:
            spool.add(key(8), payload(8))
    spool.add(key(9), bytes(2 << 20))
    assert error.value.__cause__.__traceback__  # whose frames have a view of what was written
    assert list(spool.chunks([key(7), key(9)])) == [
        payload(7), payload(7)[:5], bytes(2 << 20), b""
    ]  # fmt: skip
