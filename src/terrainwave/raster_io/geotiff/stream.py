"""Bytes that are made when they are read, as a binary file object that rasterio opens."""

import io
import threading
from typing import Any, NoReturn, Protocol

import rasterio
from rasterio.io import MemoryFile

# GDAL asks for what may lie beside a file: .aux.xml, .ovr, .msk. There is nothing.
_ENDINGS = (".tif", ".tiff")


class Bytes(Protocol):
    """What can be read at any place, by several threads at once."""

    @property
    def size(self) -> int:
        """Return the number of bytes."""
        ...

    def read_at(self, place: int, n_bytes: int) -> bytes:
        """Return `n_bytes` from byte `place` on, fewer at the end."""
        ...


class GeoTIFFStream(MemoryFile):  # type: ignore[misc]
    """A GeoTIFF as a binary file object that can be read and sought; thread-safe.

    ``rasterio.open(stream)`` reads what is asked for: rasterio would read any other file object
    into memory, but asks a `MemoryFile` to open itself. `opener` is for what takes a path and one.
    """

    def __init__(self, file: Bytes) -> None:
        super().__init__(ext=_ENDINGS[0])
        self._file = file
        self._place = 0
        self._lock = threading.Lock()

    def open(self, driver: str | None = None, sharing: bool = False, **options: Any) -> Any:
        """Open the GeoTIFF with rasterio, which calls this."""
        # A name of its own: openers go by names.
        name = self.name.rsplit("/", 1)[-1]
        return rasterio.open(name, driver=driver, sharing=sharing, opener=self.opener, **options)

    def opener(self, path: str, mode: str = "rb") -> "GeoTIFFStream":
        """Return a stream of the same bytes: ``rasterio.open("dem.tif", opener=stream.opener)``.

        Raises
        ------
        FileNotFoundError
            Unless the path ends as that of a GeoTIFF: nothing lies beside it.
        """
        if not path.endswith(_ENDINGS) or "r" not in mode:
            raise FileNotFoundError(path)
        return GeoTIFFStream(self._file)

    def __len__(self) -> int:
        return self._file.size

    def readable(self) -> bool:
        """Say yes."""
        return True

    def seekable(self) -> bool:
        """Say yes."""
        return True

    def writable(self) -> bool:
        """Say no."""
        return False

    def write(self, data: Any) -> NoReturn:  # noqa: ARG002, as files have it
        """Refuse to write."""
        raise io.UnsupportedOperation("a GeoTIFF that is made when it is read cannot be written")

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a byte counted from the start, the present one or the end; return it."""
        with self._lock:
            start = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._file.size}
            if whence not in start or start[whence] + offset < 0:
                raise ValueError(f"cannot seek to {offset} from {whence}")
            self._place = start[whence] + offset
            return self._place

    def tell(self) -> int:
        """Return the present byte."""
        return self._place

    def read(self, size: int | None = -1) -> bytes:
        """Return `size` bytes from the present one on, or all that are left."""
        with self._lock:
            left = max(self._file.size - self._place, 0)
            n_bytes = left if size is None or size < 0 else min(size, left)
            data = self._file.read_at(self._place, n_bytes)
            self._place += len(data)
            return data

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the present byte on; return how many bytes there were."""
        data = self.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)
