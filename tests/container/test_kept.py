"""The journal of finished work: records are whole or absent, after kills and power cuts."""

import os
from contextlib import ExitStack

import numpy as np
import pytest

from terrainwave.container.targets import kept as kept_module
from terrainwave.container.targets.kept import Kept, kept_directory
from terrainwave.errors import StorageError
from terrainwave.grid.quadtree import Region
from terrainwave.raster_io import temporary
from terrainwave.raster_io.temporary import Spool


@pytest.fixture
def opened(tmp_path):
    """Return what opens the work of a run; all of it is closed at the end."""
    with ExitStack() as stack:
        yield lambda run=RUN: stack.enter_context(Kept(tmp_path, run))


RUN = {"version": "1", "source": [["a.tif", 3, 4, 5]], "places": (1, 2)}


def test_records_are_found_by_the_next_run(opened, tmp_path):
    first = opened()
    first.put("a", {"n": 1}, b"abc")
    first.put("b", {"n": 2})
    first.put("a", {"n": 3}, b"de")
    first.close()
    second = opened()
    assert second.n_found == 2
    assert (second.get("a"), second.data("a")) == ({"n": 3}, b"de")
    assert second.get("b") == {"n": 2}
    assert second.get("c") is None
    second.put("c", {})
    assert opened().names() == ["a", "b", "c"]


@pytest.mark.parametrize("other", [RUN | {"version": "2"}, {}, RUN | {"places": [2, 1]}])
def test_work_of_another_run_is_removed(opened, tmp_path, other):
    first = opened()
    first.put("a", {})
    first.path("heights").write_bytes(b"x")
    first.close()
    second = opened(other)
    assert second.other["version"] == "1"
    assert second.names() == []
    assert os.listdir(tmp_path) == ["journal"]


def test_a_record_counts_only_if_it_is_whole(opened, tmp_path):
    kept = opened()
    kept.put("a", {"n": 1}, b"0123456789")
    size = (tmp_path / "journal").stat().st_size
    kept.put("b", {"n": 2}, b"0123456789")
    kept.close()
    data = (tmp_path / "journal").read_bytes()
    for length in range(size, len(data)):
        (tmp_path / "journal").write_bytes(data[:length])
        assert opened().names() == ["a"]
    for place in range(size, len(data)):
        damaged = bytearray(data)
        damaged[place] ^= 0x10
        (tmp_path / "journal").write_bytes(damaged)
        again = opened()
        assert again.names() == ["a"]
        again.put("c", {}, b"new")  # over what is not whole
        assert opened().data("c") == b"new"


@pytest.mark.parametrize("data", [b"", b"no journal", bytes(100)])
def test_a_journal_that_is_none_is_begun_anew(opened, tmp_path, data):
    (tmp_path / "journal").write_bytes(data)
    kept = opened()
    kept.put("a", {})
    kept.close()
    assert opened().names() == ["a"]


def test_after_a_power_cut_only_what_was_synchronised_counts(opened, tmp_path, monkeypatch):
    monkeypatch.setattr(kept_module, "_boot", lambda: "first")
    kept = opened()
    kept.put("a", {})
    kept._synchronise()
    kept.put("b", {})
    kept.close()
    assert opened().names() == ["a", "b"]  # a kill
    monkeypatch.setattr(kept_module, "_boot", lambda: "second")
    after = opened()
    assert after.names() == ["a"]
    after.put("c", {})
    after.close()
    assert opened().names() == ["a", "c"]


def test_arrays_are_on_the_disk_before_the_journal_says_that_all_is(opened, tmp_path, monkeypatch):
    synced = []
    sync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda file: (synced.append(file), sync(file)))
    monkeypatch.setattr(kept_module, "_SYNC", 0.0)
    kept = opened()
    kept.path("heights").write_bytes(b"x")
    kept.put("a", {})
    synced.clear()
    kept.put("b", {})
    assert len(synced) == 2


def test_windows_that_are_done_are_left_out(opened, tmp_path, monkeypatch):
    monkeypatch.setattr(temporary, "MEMORY_LIMIT", 0)
    monkeypatch.setattr(kept_module, "TICK", 0.0)
    kept = opened()
    array = Spool((4, 4), np.int32, tmp_path, path=kept.path("heights"))
    items = kept.each("level", range(5), iter, is_there=array.was_there)
    array.write(Region(0, 0, 4, 4), np.full((4, 4), 7))
    assert [next(items), next(items), next(items)] == [0, 1, 2]  # 2 is not done
    kept.close()
    again = opened()
    same = Spool((4, 4), np.int32, tmp_path, path=again.path("heights"))
    assert same.was_there
    assert (same.read(Region(0, 0, 4, 4)) == 7).all()
    assert list(again.each("level", range(5), iter, is_there=True)) == [2, 3, 4]
    assert list(again.each("level", range(5), iter, is_there=True)) == []
    array.close()
    same.close()
    monkeypatch.setattr(temporary, "MEMORY_LIMIT", 1 << 20)
    in_memory = Spool((4, 4), np.int32, tmp_path, path=again.path("heights"))
    items = again.each("level", range(5), iter, is_there=in_memory.was_there)
    assert next(items) == 0
    assert not again.is_whole("level")  # a run that is killed here leaves nothing to go on with
    assert list(items) == [1, 2, 3, 4]


def test_tiles_of_one_value_take_no_room_and_are_kept(opened, tmp_path, monkeypatch):
    monkeypatch.setattr(temporary, "MEMORY_LIMIT", 0)
    kept = opened()
    path = kept.path("heights")
    whole, side = Region(0, 0, 600, 800), temporary.TILE
    expected = np.full(whole.shape, 3.0, dtype=np.float32)
    expected[:side, :side] = 7
    expected[side : 2 * side, :side] = np.arange(side)
    expected[:side, 3 * side :] = 9  # a tile that the array's edge cuts
    expected[:side, side : 2 * side] = 0.0
    expected[5, side + 5] = -0.0  # is not 0.0
    array = Spool(whole.shape, np.float32, tmp_path, path=path)
    array.fill(whole, 3)
    for part in whole.tiles(side, side):
        if (expected[part.slices_in(whole)] != 3).any():
            array.write(part, expected[part.slices_in(whole)])
    array.close()
    assert os.stat(path).st_blocks * 512 < 3 * 4 * side**2
    again = Spool(whole.shape, np.float32, tmp_path, path=path)
    again.fill(whole, 3)  # as a run does that goes on: what was written stays
    assert again.read(whole).tobytes() == expected.tobytes()
    again.close()


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no owners")
def test_a_directory_of_another_user_is_not_used(tmp_path, monkeypatch):
    target = tmp_path / "out.twz"
    with kept_directory(tmp_path, target, RUN, fresh=False) as (path, _):
        pass
    path.mkdir()
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    with pytest.raises(StorageError, match="belongs to another user"):
        with kept_directory(tmp_path, target, RUN, fresh=False):
            pass


def test_a_kept_directory_that_is_a_link_is_not_used(tmp_path):
    target = tmp_path / "out.twz"
    with kept_directory(tmp_path, target, RUN, fresh=False) as (path, _):
        pass
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine").write_text("x")
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StorageError), kept_directory(tmp_path, target, RUN, fresh=False):
        pass
    assert (tmp_path / "elsewhere" / "mine").exists()
