"""Bytes computed when they are read, as a binary file object that rasterio opens."""

import io
import threading
from typing import Any, NoReturn, Protocol

import rasterio
from rasterio.io import MemoryFile

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
