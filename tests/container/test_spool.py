"""Temporary stores of segments: any order, little memory, no files left."""

import errno
import pickle
import threading
from unittest.mock import Mock

import numpy as np
import pytest

from terrainwave.container.spool import SegmentSpool
from terrainwave.errors import StorageError
from terrainwave.grid.quadtree import Block


def key(number):
    return Block(3, number // 10, number % 10)


def payload(number):
    return np.random.default_rng(number).bytes(1000 * (number % 40))


def filled(directory, numbers=range(60)):
    spool = SegmentSpool(directory)
    for number in numbers:
        spool.add(key(number), payload(number), 0, b"", payload(number)[:5])
    return spool


@pytest.mark.parametrize("finish", [True, False])
def test_payloads_come_back_in_the_order_asked(tmp_path, finish):
    spool = filled(tmp_path, range(59, -1, -1))
    if finish:
        spool.finish()
    wanted = [key(n) for n in range(60)]
    expected = b"".join(payload(n) + payload(n)[:5] for n in range(60))
    assert b"".join(spool.chunks(wanted)) == expected
    spool.close()


def test_a_small_segment_makes_no_file(tmp_path):
    spool = SegmentSpool(tmp_path)
    spool.add(key(0), b"abc")
    spool.finish()
    assert list(tmp_path.iterdir()) == []
    assert b"".join(spool.chunks([key(0)])) == b"abc"


def test_threads_may_add_at_the_same_time(tmp_path):
    spool = SegmentSpool(tmp_path)

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
    spool.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((key(1), b""), "already been added"),
        ((key(2), b"", 256), "flags 256"),
        ((key(2), b"", -1), "flags -1"),
        ((key(2), b"", 0, b"123"), "3 bytes of codes"),
        ((key(2), b"", 0, bytes(20)), "20 bytes of codes"),
        ((Block(-1, 0, 0), b"", 0, bytes(8)), "8 bytes of codes"),
    ],
)
def test_mistakes_of_the_caller_are_value_errors(tmp_path, arguments, message):
    spool = SegmentSpool(tmp_path)
    spool.add(key(1), b"")
    with pytest.raises(ValueError, match=message):
        spool.add(*arguments)


def test_codes_may_come_later_and_again(tmp_path):
    spool = SegmentSpool(tmp_path)
    spool.add(key(1), b"")
    with pytest.raises(KeyError):
        spool.codes(key(1))
    for codes in (bytes(16), bytes(range(16))):
        spool.set_codes(key(1), codes)
    assert spool.codes(key(1)) == bytes(range(16))


def test_a_temporary_file_that_was_damaged_is_noticed(tmp_path):
    spool = filled(tmp_path)
    spool.finish()
    (path,) = tmp_path.iterdir()
    data = bytearray(path.read_bytes())
    data[5000] ^= 1
    path.write_bytes(data)
    with pytest.raises(StorageError, match="is damaged"):
        list(spool.chunks([key(n) for n in range(60)]))
    path.unlink()
    with pytest.raises(StorageError, match="cannot read the temporary file"):
        list(spool.chunks([key(1)]))


def test_a_full_temporary_disk_is_one_clear_line(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "terrainwave.container.spool.tempfile.mkstemp",
        Mock(side_effect=OSError(errno.ENOSPC, "no space")),
    )
    with pytest.raises(StorageError, match=r"temporary files in .*: the disk is full; free space"):
        filled(tmp_path)


def test_after_a_failed_write_the_payloads_are_still_there(tmp_path, monkeypatch):
    spool = filled(tmp_path, range(8))
    monkeypatch.setattr(spool, "_directory", str(tmp_path / "missing"))
    with pytest.raises(StorageError):
        spool.finish()
    monkeypatch.setattr(spool, "_directory", str(tmp_path))
    spool.finish()
    assert list(spool.chunks([key(7)])) == [payload(7), payload(7)[:5]]
    spool.close()


def test_a_pickled_spool_reads_the_same_file(tmp_path):
    spool = filled(tmp_path)
    copy = pickle.loads(pickle.dumps(spool))
    keys = [key(n) for n in range(60)]
    assert list(copy.chunks(keys)) == list(spool.chunks(keys))
    spool.close()
