"""Head of an uncompressed GeoTIFF whose tiles are computed when they are read.

GDAL writes a sparse file, which has a head and no tiles; this module assigns consecutive offsets
after the head to each directory's tiles. So GDAL writes all of a GeoTIFF's metadata.
"""

import io
import struct
import threading
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile
from rasterio.windows import Window

from terrainwave.errors import LimitExceededError
from terrainwave.raster_io.gdal import bounded_env
from terrainwave.raster_io.geotiff.sink import TILE, geotiff_profile, write_description
from terrainwave.raster_io.raster_info import DOMAIN, RasterInfo

# Tags of a directory (TIFF 6.0, sections 8 and 15) and the types of their values.
_SUBFILE_TYPE, _WIDTH, _LENGTH, _BITS, _COMPRESSION = 254, 256, 257, 258, 259
_TILE_WIDTH, _TILE_LENGTH, _TILE_OFFSETS, _TILE_BYTES = 322, 323, 324, 325
_FORMATS = {3: "<H", 4: "<I", 16: "<Q"}
_IS_MASK = 4
_UNCOMPRESSED = 1
# Alignment of tiles. GDAL requests pieces of this size over HTTP: no tile shares one with the head.
_ALIGNMENT = 1 << 14
# Above this, 32-bit offsets are too small; the rest is ample for the head.
_MOST_CLASSIC = (1 << 32) - (1 << 28)
# Tiles of the full grid: above the first number tiles are made larger, above the second the file is
# refused. A head has 16 bytes for each tile, a third more for overviews, and as much again for a
# mask.
_MANY_TILES, _MOST_TILES = 1 << 19, 1 << 21


class Plane(NamedTuple):
    """Directory of the file: heights or mask, of the full grid or of an overview.

    Samples are averages of 2^`shift` per side; tiles of `tile` samples per side begin at byte
    `start`, `tile_bytes` each, row by row.
    """

    shift: int
    is_mask: bool
    shape: tuple[int, int]
    tile: int
    start: int
    tile_bytes: int

    @property
    def n_across(self) -> int:
        return -(-self.shape[1] // self.tile)

    @property
    def n_tiles(self) -> int:
        return self.n_across * -(-self.shape[0] // self.tile)

    @property
    def stop(self) -> int:
        return self.start + self.n_tiles * self.tile_bytes


class _Entry(NamedTuple):
    """Tag of a directory: the offset of its value, and the value if it is one number."""

    place: int
    value: int | None


def sparse_geotiff(
    info: RasterInfo, n_overviews: int, stated: Mapping[str, str]
) -> tuple[bytes, list[Plane]]:
    """Return the head of a GeoTIFF with some overviews, and its planes, the coarsest first.

    `stated`: items of the band's metadata, in `DOMAIN`. Overviews do not have them. Raises
    `LimitExceededError` if the head would be longer than some 100 MB.
    """
    tile = _tile_side(info)
    # Overviews and mask add less than half.
    is_big = 3 * info.n_bytes // 2 > _MOST_CLASSIC
    head = _written_by_gdal(info, n_overviews, stated, is_big, tile)
    directories = sorted(_directories(head, is_big), key=_width_of)
    planes: list[Plane] = []
    for fields in directories:
        shift = n_overviews + 1 - (_width_of(fields).bit_length() - 1)
        shape = (-(-info.n_rows >> shift), -(-info.n_cols >> shift))
        planes.append(_plane_of(fields, shift, shape))
    place = len(head) + sum(2 * plane.n_tiles * (8 if is_big else 4) for plane in planes)
    place += -place % _ALIGNMENT
    for index, fields in enumerate(directories):
        planes[index] = plane = planes[index]._replace(start=place)
        _describe(head, fields, plane, is_big)
        place = plane.stop
    head += bytes(planes[0].start - len(head))
    return bytes(head), planes


def _tile_side(info: RasterInfo) -> int:
    """Return the side of the tiles: the head, which is read whole, has an entry for each tile."""
    for side in (TILE, 2 * TILE, 4 * TILE):
        n_tiles = -(-info.n_rows // side) * -(-info.n_cols // side)
        if n_tiles <= (_MANY_TILES if side < 4 * TILE else _MOST_TILES):
            return side
    raise LimitExceededError(
        f"the raster has {info.n_rows:,} x {info.n_cols:,} samples, more than a GeoTIFF of at most"
        f" {_MOST_TILES:,} tiles holds; read a window of it"
    )


def _written_by_gdal(
    info: RasterInfo, n_overviews: int, stated: Mapping[str, str], is_big: bool, tile: int
) -> bytearray:
    """Return a sparse file of 2 << `n_overviews` samples per side: GDAL visits all tiles."""
    side = 2 << n_overviews
    profile = geotiff_profile(replace(info, n_rows=side, n_cols=side)) | {
        "blockxsize": tile,
        "blockysize": tile,
        "sparse_ok": True,
        "bigtiff": "YES" if is_big else "NO",
        "endianness": "LITTLE",
    }
    # Overviews have a tile size of their own.
    options = {
        "GDAL_TIFF_INTERNAL_MASK": True,
        "SPARSE_OK_OVERVIEW": True,
        "GDAL_TIFF_OVR_BLOCKSIZE": tile,
    }
    with bounded_env(**options), warnings.catch_warnings(), MemoryFile(ext=".tif") as memory:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with memory.open(**profile) as dataset:
            write_description(dataset, info)
            dataset.update_tags(1, ns=DOMAIN, **stated)
            if info.mask_kind == "mask":
                dataset.write_mask(np.zeros((1, 1), dtype=np.uint8), window=Window(0, 0, 1, 1))
        if n_overviews:
            with rasterio.open(memory.name, "r+") as dataset:
                factors = [1 << shift for shift in range(1, n_overviews + 1)]
                dataset.build_overviews(factors, Resampling.nearest)
        return bytearray(memory.getbuffer())


def _directories(head: bytearray, is_big: bool) -> Iterator[dict[int, _Entry]]:
    link, count, entry_bytes, value_at = ("<Q", "<Q", 20, 12) if is_big else ("<I", "<H", 12, 8)
    (place,) = struct.unpack_from(link, head, 8 if is_big else 4)
    while place:
        (n_entries,) = struct.unpack_from(count, head, place)
        place += struct.calcsize(count)
        fields = {}
        for _ in range(n_entries):
            tag, kind = struct.unpack_from("<HH", head, place)
            (n_values,) = struct.unpack_from(link, head, place + 4)
            value = None
            if n_values == 1 and kind in _FORMATS:
                (value,) = struct.unpack_from(_FORMATS[kind], head, place + value_at)
            fields[tag] = _Entry(place, value)
            place += entry_bytes
        yield fields
        (place,) = struct.unpack_from(link, head, place)


def _width_of(fields: dict[int, _Entry]) -> int:
    return fields[_WIDTH].value or 0


def _plane_of(fields: dict[int, _Entry], shift: int, shape: tuple[int, int]) -> Plane:
    numbers = {tag: entry.value for tag, entry in fields.items() if entry.value is not None}
    tile = numbers[_TILE_WIDTH]
    assert tile == numbers[_TILE_LENGTH]
    return Plane(
        shift=shift,
        is_mask=bool(numbers.get(_SUBFILE_TYPE, 0) & _IS_MASK),
        shape=shape,
        tile=tile,
        start=0,
        tile_bytes=tile * (-(-tile * numbers[_BITS] // 8)),
    )


def _describe(head: bytearray, fields: dict[int, _Entry], plane: Plane, is_big: bool) -> None:
    offsets = plane.start + plane.tile_bytes * np.arange(plane.n_tiles, dtype=np.uint64)
    for tag, values in (
        (_LENGTH, np.array(plane.shape[:1])),
        (_WIDTH, np.array(plane.shape[1:])),
        (_TILE_OFFSETS, offsets),
        (_TILE_BYTES, np.full(plane.n_tiles, plane.tile_bytes)),
    ):
        _put(head, fields[tag], values, is_big)
    struct.pack_into("<H", head, fields[_COMPRESSION].place + (12 if is_big else 8), _UNCOMPRESSED)


def _put(head: bytearray, entry: _Entry, values: NDArray[np.integer], is_big: bool) -> None:
    data = values.astype("<u8" if is_big else "<u4").tobytes()
    link = "<Q" if is_big else "<I"
    struct.pack_into("<H", head, entry.place + 2, 16 if is_big else 4)
    struct.pack_into(link, head, entry.place + 4, values.size)
    value_at = entry.place + (12 if is_big else 8)
    if values.size == 1:
        head[value_at : value_at + len(data)] = data
    else:
        struct.pack_into(link, head, value_at, len(head))
        head += data


# GDAL also looks for .aux.xml, .ovr and .msk files, which do not exist.
_ENDINGS = (".tif", ".tiff")


class Bytes(Protocol):
    """Data that can be read at any offset, by several threads at once."""

    @property
    def size(self) -> int: ...

    def read_at(self, place: int, n_bytes: int) -> bytes:
        """Return `n_bytes` from byte `place` on, fewer at the end."""
        ...


class GeoTIFFStream(MemoryFile):  # type: ignore[misc]
    """A GeoTIFF as a seekable binary file object; thread-safe.

    ``rasterio.open(stream)`` reads only the requested parts, as a `MemoryFile` may open itself.
    `opener` is for functions that take a path and an opener.
    """

    def __init__(self, file: Bytes) -> None:
        super().__init__(ext=_ENDINGS[0])
        self._file = file
        self._place = 0
        self._lock = threading.Lock()

    def open(self, driver: str | None = None, sharing: bool = False, **options: Any) -> Any:
        # A unique name: openers are identified by names.
        name = self.name.rsplit("/", 1)[-1]
        return rasterio.open(name, driver=driver, sharing=sharing, opener=self.opener, **options)

    def opener(self, path: str, mode: str = "rb") -> "GeoTIFFStream":
        """Return a stream of the same bytes: ``rasterio.open("dem.tif", opener=stream.opener)``."""
        if not path.endswith(_ENDINGS) or "r" not in mode:
            raise FileNotFoundError(path)
        return GeoTIFFStream(self._file)

    def __len__(self) -> int:
        return self._file.size

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def writable(self) -> bool:
        return False

    def write(self, data: Any) -> NoReturn:  # noqa: ARG002, as files have it
        raise io.UnsupportedOperation("a GeoTIFF that is made when it is read cannot be written")

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        with self._lock:
            start = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._file.size}
            if whence not in start or start[whence] + offset < 0:
                raise ValueError(f"cannot seek to {offset} from {whence}")
            self._place = start[whence] + offset
            return self._place

    def tell(self) -> int:
        return self._place

    def read(self, size: int | None = -1) -> bytes:
        with self._lock:
            left = max(self._file.size - self._place, 0)
            n_bytes = left if size is None or size < 0 else min(size, left)
            data = self._file.read_at(self._place, n_bytes)
            self._place += len(data)
            return data

    def readinto(self, buffer: Any) -> int:
        data = self.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)
