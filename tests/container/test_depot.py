"""A depot on stores that fail: an object store with put, get, head and delete of known names."""

import os
from collections import Counter
from typing import ClassVar

import fsspec
import numpy as np
import pytest
from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem
from fsspec.registry import _registry

from terrainwave.container.depot import Depot
from terrainwave.errors import CorruptStreamError, StorageError


class Store(AbstractFileSystem):
    """An object store that has nothing else, and whose lists show nothing.

    `fails` are requests that fail before one succeeds, `late` how often what has been put is still
    not there.
    """

    protocol = "s3"
    cachable = False
    objects: ClassVar[dict[str, bytes]] = {}
    unseen: ClassVar[dict[str, int]] = {}
    fails: ClassVar[Counter[str]] = Counter()
    late = 0

    def _may_fail(self, request):
        if self.fails[request]:
            self.fails[request] -= 1
            raise ConnectionError("the connection was cut in the middle")

    def pipe_file(self, path, value, **_):
        self._may_fail("put")
        self.objects[path], self.unseen[path] = value, self.late

    def info(self, path, **_):
        if path not in self.objects:
            raise FileNotFoundError(path)
        if self.unseen[path]:
            self.unseen[path] -= 1
            raise FileNotFoundError(path)
        return {"name": path, "size": len(self.objects[path]), "type": "file"}

    def cat_file(self, path, start=None, end=None, **_):
        self._may_fail("get")
        return self.objects[path][start:end]

    def rm_file(self, path):
        if path not in self.objects:
            raise FileNotFoundError(path)
        del self.objects[path]

    def ls(self, path, detail=True, **_):
        return []


class Folders(LocalFileSystem):
    """A server of files, whose folders must be there before a file is written."""

    protocol = "sftp"

    @classmethod
    def _strip_protocol(cls, path):
        return super()._strip_protocol(path.removeprefix("sftp://server"))


@pytest.fixture
def store(monkeypatch):
    monkeypatch.setattr("terrainwave.container.depot._DELAYS", (0.0, 0.0, 0.0))
    monkeypatch.setattr("terrainwave.container.sources.url._DELAYS", ())
    monkeypatch.setattr(Store, "late", 0)
    for state in (Store.objects, Store.unseen, Store.fails):
        state.clear()
    fsspec.register_implementation("s3", Store, clobber=True)
    yield Store
    _registry.pop("s3")


@pytest.fixture
def depot(store):
    return Depot("s3://bucket/scratch")


HEIGHTS = np.arange(12).reshape(3, 4)


def test_folders_of_a_server_are_made(tmp_path, monkeypatch):
    monkeypatch.setattr("terrainwave.container.depot._DELAYS", ())
    monkeypatch.setitem(_registry, "sftp", Folders)
    Depot(f"sftp://server{tmp_path}/scratch/run").save("a", heights=HEIGHTS)
    with np.load(tmp_path / "scratch" / "run" / "a") as arrays:
        assert (arrays["heights"] == HEIGHTS).all()


@pytest.mark.parametrize("request_name", ["put", "get"])
def test_a_request_that_fails_is_repeated(depot, store, request_name):
    store.fails[request_name] = 3
    depot.save("a", heights=HEIGHTS)
    assert (depot.load("a")["heights"] == HEIGHTS).all()
    assert store.fails[request_name] == 0


def test_a_put_that_always_fails_is_one_line(depot, store):
    store.fails["put"] = 99
    with pytest.raises(StorageError, match=r"cannot write s3://bucket/scratch/a: the connection"):
        depot.save("a", heights=HEIGHTS)
    assert not store.objects


def test_an_entry_that_the_store_shows_late_is_waited_for(depot, store):
    store.late = 2
    depot.save("a", heights=HEIGHTS)
    assert (depot.load("a")["heights"] == HEIGHTS).all()


def test_an_entry_that_is_not_there_is_one_line(depot):
    with pytest.raises(StorageError, match=r"cannot read s3://bucket/scratch/a: no such file"):
        depot.load("a")


def test_all_names_are_removed_though_a_list_shows_nothing(depot, store):
    names = [f"entry-{number}" for number in range(5)]
    for name in names:
        depot.save(name, heights=HEIGHTS)
    assert len(store.objects) == 5
    depot.remove([*names, "never there"])
    assert not store.objects


def test_a_damaged_entry_is_one_line(depot, store):
    depot.save("a", heights=HEIGHTS)
    (path,) = store.objects
    store.objects[path] = store.objects[path][:-30]
    with pytest.raises(CorruptStreamError, match=r"scratch/a is damaged: found \d+ bytes"):
        depot.load("a")


def test_a_part_of_an_entry_is_read_again_where_a_request_fails(depot, store):
    depot.put("a", b"page and payload")
    store.fails["get"] = 2
    assert depot.part("a", 4, 4) == b" and"
    assert depot.part("a", 4, 0) == b""


def test_an_unfinished_entry_of_a_directory_is_removed(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(StorageError, match=r"a: the disk is full; free space there, or name"):
        Depot(str(tmp_path)).put("a", b"data")
    assert not os.listdir(tmp_path)


def test_a_scheme_that_nothing_is_installed_for_is_one_line():
    with pytest.raises(StorageError, match="cannot use nonsense://bucket: Protocol not known"):
        Depot("nonsense://bucket").save("a", heights=HEIGHTS)
