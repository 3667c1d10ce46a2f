"""Files within a zip that is a file, on a web server or anywhere else."""

import pickle
import warnings
import zipfile

import pytest
from container.test_http import serving
from container.test_url import running_server
from container.toys import toy_file, toy_header, toy_payload
from containers import open_container

import terrainwave.container.sources.zip_member as module
from terrainwave.container.sources.opening import open_source
from terrainwave.errors import StorageError, TerrainwaveWarning

HEADER = toy_header(2000, 1999)


@pytest.fixture
def packed(tmp_path):
    """Return the path of a zip with a stored and a deflated file, and the file's bytes."""
    data = toy_file(HEADER)
    path = tmp_path / "all.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("read.me", bytes(100_000))
        stored = zipfile.ZipInfo("dir/höhe 1.twz")
        stored.extra = b"UT\x05\x00\x01\x00\x00\x00\x00"  # a time, as Info-ZIP notes it
        archive.writestr(stored, data)
        archive.writestr("deflated.twz", data, zipfile.ZIP_DEFLATED)
        archive.writestr("later", bytes(200_000))
    return path, data


def agrees(address, key):
    with open_container(address) as container:
        copy = pickle.loads(pickle.dumps(container))
        assert container.header == HEADER
        found = container.payload(key), copy.payload(key)
        copy.close()
        return found == (toy_payload(key),) * 2


def test_a_stored_file_of_a_zip_is_read_by_ranges_over_http(packed):
    path, _ = packed
    key = HEADER.grid.blocks(5)[-1]
    with running_server() as server:
        server.files["/a%20b.zip"] = path.read_bytes()
        address = f"zip://dir/höhe 1.twz::{server.url('/a b.zip')}?sig=hidden"
        with open_container(address) as container:
            # Opening the zip, its end, the member's head; the first 16 KiB of the file.
            assert len(server.requests) <= 4
            assert container.payload(key) == toy_payload(key)
            assert container.source.name == f"zip://dir/höhe 1.twz::{server.url('/a b.zip')}"
        assert server.n_bytes < len(path.read_bytes()) / 2
        assert agrees(address, key)


@pytest.mark.parametrize("form", ["{path}", "file://{path}"])
def test_a_zip_may_be_a_local_file(packed, form):
    path, _ = packed
    key = HEADER.grid.blocks(5)[0]
    assert agrees("zip://dir/höhe 1.twz::" + form.format(path=path), key)


def test_a_zip_may_be_behind_fsspec(packed, memory):
    path, _ = packed
    memory.pipe("/all.zip", path.read_bytes())
    assert agrees("zip://dir/höhe 1.twz::memory://all.zip", HEADER.grid.blocks(5)[0])


def test_a_chain_of_fsspec_is_read(packed, memory, tmp_path):
    path, data = packed
    memory.pipe("/all.zip", path.read_bytes())
    memory.pipe("/a.twz", data)
    key = HEADER.grid.blocks(5)[0]
    assert agrees("simplecache::memory://a.twz", key)
    assert agrees("zip://dir/höhe 1.twz::simplecache::memory://all.zip", key)


def test_a_small_deflated_file_is_read_whole_and_a_large_one_refused(packed, monkeypatch):
    path, data = packed
    address = f"zip://deflated.twz::{path}"
    with pytest.warns(TerrainwaveWarning, match=r"deflated.twz::.*compressed in its archive"):
        source = open_source(address)
    assert source.read(1000, 99) == data[1000:1099]
    monkeypatch.setattr(module, "MAX_WHOLE", len(data) - 1)
    with pytest.raises(StorageError, match=r"store it without compression \(zip -0\)"):
        open_source(address)


def test_other_ways_to_compress_are_refused_by_name(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.twz", toy_file(HEADER), zipfile.ZIP_BZIP2)
    with pytest.raises(StorageError, match=r"by method 12 .*\(zip -0\)"):
        open_source(f"zip://a.twz::{path}")


def test_a_name_that_the_zip_has_not_is_named_with_those_it_has(packed):
    path, _ = packed
    with pytest.raises(StorageError) as caught:
        open_source(f"zip://none.twz::{path}")
    assert str(caught.value) == (
        f"{path} has no file none.twz; found read.me, dir/höhe 1.twz, deflated.twz, later"
    )


def test_a_zip_that_is_replaced_is_noticed(packed):
    path, _ = packed
    with running_server() as server:
        server.files["/a.zip"], server.etags["/a.zip"] = path.read_bytes(), '"1"'
        source = open_source(f"zip://dir/höhe 1.twz::{server.url('/a.zip')}")
        server.etags["/a.zip"] = '"2"'
        with pytest.raises(StorageError, match="has changed while it was open"):
            source.read(30_000, 100)
        source.close()
        with pytest.raises(StorageError, match="is closed"):
            source.read(0, 1)


def test_a_zip_on_a_server_that_is_none_is_one_clear_line():
    with serving() as server, pytest.raises(StorageError, match="not a zip file") as caught:
        open_source(f"zip://a.twz::{server.url}/a?sig=hidden")
    assert "hidden" not in str(caught.value)


def test_every_prefix_and_every_changed_byte_of_a_zip_is_our_error_or_bytes(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", b"heights")
        archive.writestr("b", b"heights" * 9, zipfile.ZIP_DEFLATED)
    whole = path.read_bytes()
    damaged = [whole[:n] for n in range(len(whole))]
    for flip in (1, 0x80, 0xFF):
        for at in range(len(whole)):
            damaged.append(whole[:at] + bytes([whole[at] ^ flip]) + whole[at + 1 :])
    n_read, messages = 0, set()
    for data in damaged:
        path.write_bytes(data)
        for name in "ab":
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    source = open_source(f"zip://{name}::{path}")
            except StorageError as error:
                messages.add(str(error))
                continue
            n_read += 1
            assert len(source.read(0, source.size)) == source.size
            source.close()
    assert n_read > 100
    assert not any("\n" in message for message in messages)
