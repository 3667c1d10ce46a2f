"""Segments and arrays on storage shared by several machines, until the file is assembled.

A segment is stored as its page, then its payloads and meshes in the file's own order (FORMAT.md
§3.2). Its page's `first_child` is 0, as offsets in the file are still unknown.

An object store needs only put, get, head and delete of known names. Failed puts are repeated, and
missing objects are requested again, so the store may show them late.
"""

import io
import os
import secrets
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import in_one_line
from terrainwave.cache import Cache
from terrainwave.container.page import describe_head, empty_page, page_layout, unpack_page
from terrainwave.container.reader import check_crc
from terrainwave.container.segment import Segment, segment_of_page
from terrainwave.container.sources.addresses import display_name, without_secrets
from terrainwave.container.sources.shared import CHUNK, SharedSource, repeated
from terrainwave.container.spool import TEMPORARY_ADVICE, StoredSegment, storage_errors
from terrainwave.container.targets.upload import put_whole
from terrainwave.container.writer import Segments, write_segments
from terrainwave.errors import CorruptStreamError, StorageError, TerrainwaveError
from terrainwave.extras import need
from terrainwave.grid.quadtree import Block, Grid

_OPEN_SOURCES = 32
_CACHED_PAGES = 64
_NAMES_AT_A_TIME = 1000  # limit of S3's delete request
_ADVICE = "; free space there, or name another directory or URL with `temp_dir`"


@dataclass(frozen=True)
class Depot:
    """A directory that all machines of a run see: a path, or a URL that fsspec can write to.

    Entries appear whole or not at all, so a task can run again after its machine was lost, or twice
    at a time.

    Parameters
    ----------
    directory : str, optional
        Directory for entries before they are uploaded; by default the system's.
    """

    root: str
    directory: str | None = None

    def path(self, name: str) -> str:
        """Return the path or URL of an entry."""
        return f"{self.root}/{name}"

    @contextmanager
    def create(self, name: str) -> Iterator[BinaryIO]:
        """Yield a file to write; it appears when the block ends without exception.

        Raises
        ------
        StorageError
            If it cannot be written.
        """
        where = display_name(self.path(name))
        filesystem, path = _filesystem(self.root)
        target = f"{path}/{name}"
        making = (
            _in_place(target, where)
            if "file" in filesystem.protocol
            else self._put(filesystem, target, where)
        )
        with making as file:
            yield file

    @contextmanager
    def _put(self, filesystem: Any, target: str, where: str) -> Iterator[BinaryIO]:
        """Yield a local file that is uploaded to a store when the block ends.

        fsspec's own files are not used: after an exception they upload what they have.
        """
        directory = self.directory or tempfile.gettempdir()
        failing = f"cannot write temporary files in {directory}"
        with storage_errors(failing, advice=TEMPORARY_ADVICE):
            handle, made = tempfile.mkstemp(".twz-part", dir=directory)

        def put() -> None:
            try:
                put_whole(filesystem, made, target)
            except Exception as error:  # of the file system's own libraries
                raise StorageError(
                    f"cannot write {where}: {without_secrets(in_one_line(error))}"
                ) from error

        try:
            with storage_errors(failing, advice=TEMPORARY_ADVICE), os.fdopen(handle, "wb") as file:
                yield file
            repeated(f"writing {where}", put)
        finally:
            os.unlink(made)

    def save(self, name: str, **arrays: Any) -> None:
        """Store arrays under a name."""
        with self.create(name) as file:
            np.savez(file, **arrays)

    def load(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the arrays stored by `save`.

        Raises
        ------
        StorageError
            If the entry does not exist.
        CorruptStreamError
            If it is damaged.
        """
        entry = SharedSource(self.path(name))
        try:
            data = entry.read(0, entry.size)
        finally:
            entry.close()
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                return dict(arrays)
        except (ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise CorruptStreamError(
                f"{display_name(self.path(name))} is damaged: found {len(data):,} bytes that are"
                " not the arrays that a worker stored there"
            ) from error

    def fetch(self, path: str, local: str | os.PathLike[str]) -> None:
        """Copy an entry to a local file.

        Raises
        ------
        StorageError
            If it cannot be read, or the file cannot be written.
        """
        entry = SharedSource(path)
        failing = f"cannot write temporary files in {os.path.dirname(local)}"
        try:
            with storage_errors(failing, advice=TEMPORARY_ADVICE), open(local, "wb") as file:
                for start in range(0, entry.size, CHUNK):
                    file.write(entry.read(start, min(CHUNK, entry.size - start)))
        finally:
            entry.close()

    def remove(self, names: Iterable[str] = ()) -> None:
        """Delete everything in the depot: `names`, and all entries that it lists.

        Raises
        ------
        StorageError
            If something cannot be deleted.
        """
        where = display_name(self.root)
        try:
            filesystem, path = _filesystem(self.root)
            if "file" not in filesystem.protocol:
                known = [f"{path}/{name}" for name in dict.fromkeys(names)]
                for start in range(0, len(known), _NAMES_AT_A_TIME):
                    _delete(filesystem, known[start : start + _NAMES_AT_A_TIME])
                filesystem.invalidate_cache()
            with suppress(FileNotFoundError):
                if filesystem.exists(path):
                    filesystem.rm(path, recursive=True)
        except TerrainwaveError:
            raise
        except Exception as error:  # of the file system's own libraries
            reason = without_secrets(in_one_line(error))
            raise StorageError(f"cannot remove temporary data in {where}: {reason}") from error


@contextmanager
def _in_place(target: str, where: str) -> Iterator[BinaryIO]:
    """Yield a file that gets its name when the block ends without exception."""
    unfinished = f"{target}.{secrets.token_hex(8)}"
    with storage_errors(f"cannot write {where}", advice=_ADVICE):
        try:
            with open(unfinished, "wb") as file:
                yield file
            os.replace(unfinished, target)
        except BaseException:
            with suppress(OSError):
                os.unlink(unfinished)
            raise


def _delete(filesystem: Any, paths: list[str]) -> None:
    """Delete the existing ones of some paths."""
    try:
        filesystem.rm(paths)
    except FileNotFoundError:  # unknown which: delete one after the other
        for path in paths:
            with suppress(FileNotFoundError):
                filesystem.rm_file(path)


def _filesystem(root: str) -> tuple[Any, str]:
    """Return fsspec's file system for a path or URL, and the path in it."""
    fsspec = need("fsspec.core", extra="distributed", purpose="a cluster")
    try:
        filesystem, path = fsspec.url_to_fs(root)
    except (ImportError, ValueError) as error:
        raise StorageError(f"cannot use {display_name(root)}: {in_one_line(error)}") from error
    return filesystem, path


def store_segments(
    depot: Depot, name: str, grid: Grid, heads: Sequence[Block | None], spools: Segments
) -> dict[Block | None, StoredSegment]:
    """Store segments in the order of `heads` in one file of a depot (`write_segments`).

    Behind them are their lengths, for `stored_places`.
    """
    with depot.create(name) as file:
        places = write_segments(file, depot.path(name), grid, heads, spools)
        lengths = [(place.page_length, place.length) for place in places.values()]
        file.write(np.array(lengths, dtype="<u8").tobytes())
    return places


def stored_places(
    depot: Depot, name: str, heads: Sequence[Block | None]
) -> dict[Block | None, StoredSegment]:
    """Return the result of `store_segments` for the same name and heads."""
    places, offset = {}, 0
    with closing(SharedSource(depot.path(name))) as entry:
        n_bytes = 16 * len(heads)
        ends = np.frombuffer(entry.read(entry.size - n_bytes, n_bytes), "<u8").reshape(-1, 2)
    for head, (of_page, length) in zip(heads, ends.tolist(), strict=True):
        places[head] = StoredSegment(depot.path(name), offset, of_page, length)
        offset += length
    return places


class StoredSegments:
    """Payloads, meshes and codes of stored segments, by key; not thread-safe.

    Parameters
    ----------
    place : callable
        Returns the position of a segment, by its head.
    """

    def __init__(self, grid: Grid, place: Callable[[Block | None], StoredSegment]) -> None:
        self._grid = grid
        self._place = place
        self._sources: Cache[str, SharedSource] = Cache(
            _OPEN_SOURCES, drop=lambda source: source.close()
        )
        self._segments: Cache[Block | None, Segment] = Cache(_CACHED_PAGES)

    def payloads(self, keys: Sequence[Block]) -> list[bytes]:
        """Return the payloads of `keys`; raise `CorruptStreamError` if a checksum is wrong."""
        return [self._section(key, is_mesh=False) for key in keys]

    def mesh(self, key: Block) -> bytes:
        """Return the mesh section of `key`; empty if it has none."""
        return self._section(key, is_mesh=True)

    def codes(self, block: Block) -> tuple[int, int, int, int]:
        """Return the codes of `block`: z_min, z_max, error, mesh error."""
        head = None if block.level == 0 else self._grid.segment_head(block.parent)
        segment = self._segment(head)
        return segment.codes(block)

    def close(self) -> None:
        self._sources.clear()

    def __enter__(self) -> "StoredSegments":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _section(self, key: Block, *, is_mesh: bool) -> bytes:
        head = None if key.is_root_key else self._grid.segment_head(key)
        segment = self._segment(head)
        row = segment.layout.key_rows[key]
        if is_mesh:
            wanted, crcs, kind = segment.mesh_range(row), segment.page.mesh_crcs, "mesh"
        else:
            wanted, crcs, kind = segment.payload_range(row), segment.page.payload_crcs, "payload"
        if not wanted.length:
            return b""
        data = self._source(self._place(head).path).read(*wanted)
        check_crc(data, crcs[row], kind, key)
        return data

    def _segment(self, head: Block | None) -> Segment:
        return self._segments.get_or_make(head, lambda: self._load(head))

    def _load(self, head: Block | None) -> Segment:
        layout, place = page_layout(self._grid, head), self._place(head)
        page = empty_page(layout)
        if place.length:
            data = self._source(place.path).read(place.offset, place.page_length)
            page = unpack_page(data, layout, f"the page of {describe_head(head)}")
        start = place.offset + place.page_length
        return segment_of_page(head, layout, page, start, has_pages=False)

    def _source(self, path: str) -> SharedSource:
        return self._sources.get_or_make(path, lambda: SharedSource(path))
