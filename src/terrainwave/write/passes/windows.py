"""Pass A: a raster's windows, scanned once and read again."""

import shutil
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import count_of, size_of
from terrainwave.container.targets.kept import Kept
from terrainwave.errors import StorageError, TerrainwaveError
from terrainwave.grid.crew import Crew
from terrainwave.grid.digest import HeightDigest
from terrainwave.grid.quadtree import Region
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.progress import Reporter
from terrainwave.raster_io.even import Even, are_bits, even_parts
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.temporary import MEMORY_LIMIT, Spool
from terrainwave.write.passes.seen import SIDE, SeenTiles
from terrainwave.write.pyramid import SourceWindows

# Names of records: of the scan, of the array of valid samples, and of the file of even tiles.
_SCAN, _VALID, _SEEN = "scan", "valid", "seen"
Window = tuple[NDArray[Any], NDArray[np.bool_]]  # heights and validity
Part = tuple[Region, Even | None]
# Sides, in samples, of windows in which even regions are reported whole, and of windows that are
# searched for them: next to even regions, fills of voids reach about as far.
_SIDE, _UNEVEN_SIDE = 4096, 1024
# Checksums of so many windows take some 10 MB, whatever the size of the raster.
_MOST_CHECKSUMS = 1 << 16


class Windows(SourceWindows):
    """The source's windows, spooled during the scan if it is slow to read.

    A narrow window of a striped raster decodes whole strips, again for each of its neighbours. A
    small raster is held in memory, as each sample is read two or three times.
    """

    def __init__(self, source: RasterSource, directory: Path, kept: Kept) -> None:
        self._source = source
        self._shape = source.info.n_rows, source.info.n_cols
        self._directory = directory
        self._heights: Spool | None = None
        self._valid: Spool | None = None  # None if there are no voids
        if source.is_striped or (source.is_file and source.info.n_bytes <= MEMORY_LIMIT):
            path = kept.path("heights")
            self._heights = Spool(self._shape, source.info.dtype, directory, path=path)
        # Of windows that later passes read again; not of those that an earlier run has scanned.
        self._checksums: dict[Region, int] = {}
        self._kept = kept
        self._seen = SeenTiles(self._shape, source.info.dtype, kept.path(_SEEN))
        self._lock = threading.Lock()

    def _is_there(self) -> bool:
        """Return whether all that an earlier run has stored of windows is there."""
        if self._heights is None:
            return self._seen.was_there
        has_voids = self._kept.get(_VALID) is not None
        arrays = [self._heights, *([self._valid_spool()] if has_voids else [])]
        return self._seen.was_there and all(array.was_there for array in arrays)

    def scan(
        self, crew: Crew, reporter: Reporter, has_digest: bool, steps: FixedSteps | None = None
    ) -> HeightScan:
        """Return range, validity, vertical quantum and, if wanted, a digest of all windows.

        In the source's order. Windows that an earlier run has scanned are not read again. Each
        thread of `crew` reads one window at a time.
        """
        scan = new_scan(self._source.info, has_digest, steps)
        is_there, state = self._is_there(), self._kept.get(_SCAN)
        if is_there and state is not None and "scan" in state:
            scan.take_state(state["scan"])

        def side_by_side(parts: Iterable[Part]) -> Iterator[tuple[Region, Even | Window]]:
            parts = iter(parts)
            while some := list(islice(parts, crew.n_threads)):
                yield from crew.map(self._scanned, some)

        for region, found in self._kept.each(
            _SCAN, self._parts(), side_by_side,
            is_there=is_there, values=lambda: {"scan": scan.to_state()},
        ):  # fmt: skip
            take(scan, region, found, self._source.info, reporter)
        return scan

    def _parts(self) -> Iterator[Part]:
        for region, even in self._source.parts():
            if even is not None:
                self._seen.note_even(region, even)
                if self._heights is not None:
                    self._heights.fill(region, even.value)
                    if self._valid is not None or not even.is_valid:
                        self._valid_spool().fill(region, even.is_valid)
            yield region, even

    def _scanned(self, part: Part) -> tuple[Region, Even | Window]:
        region, even = part
        if even is not None:
            return region, even
        heights, valid = self._source.read(*region)
        self._seen.note(region, heights, valid)
        if self._heights is None:
            if len(self._checksums) < _MOST_CHECKSUMS:
                self._checksums[region] = _checksum(heights, valid)
        else:
            self._heights.write(region, heights)
            if self._valid is not None or not valid.all():
                self._valid_spool().write(region, valid)
        return region, (heights, valid)

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Say that the raster has changed, if that is why a pass over it failed."""
        try:
            yield
        except TerrainwaveError as error:
            for region, checksum in self._checksums.items():
                if _checksum(*self._source.read(*region)) != checksum:
                    raise changed(
                        self._source.name,
                        f" in {region.n_rows} x {region.n_cols}"
                        f" samples from row {region.row}, column {region.col}",
                    ) from error
            raise

    def _valid_spool(self) -> Spool:
        with self._lock:
            if self._valid is None:
                path = self._kept.path(_VALID)
                valid = Spool(self._shape, np.bool_, self._directory, path=path)
                valid.fill(valid.region, True)  # samples before the first void
                self._kept.put(_VALID, {})
                self._valid = valid
        return self._valid

    def even(self, region: Region) -> Even | None:
        """Return the content of an even region; None if neither index nor scan know it."""
        return self._source.even(region) or self._seen.even(region)

    def holds(self, region: Region, even: Even) -> bool:
        """Return whether a region is what index or scan say, by reading it again.

        Reads all samples known only from the scan, and some of each part known from the index
        (`RasterSource.holds`).
        """
        return all(
            self._source.holds(part, known) if known is not None else self._is_all(part, even)
            for part, known in even_parts(region, SIDE, self._source.even)
        )

    def _is_all(self, region: Region, even: Even) -> bool:
        heights, valid = self.read(*region)
        if not even.is_valid:
            return not valid.any()
        return bool(valid.all() and are_bits(heights, even.value).all())

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return raw heights and validity of a window, both read-only."""
        if self._heights is None:
            return self._source.read(row, col, n_rows, n_cols)
        region = Region(row, col, n_rows, n_cols)
        if self._valid is None:
            return self._heights.view(region), np.ones(region.shape, dtype=np.bool_)
        return self._heights.view(region), self._valid.view(region)

    def close(self) -> None:
        self._seen.close()
        for spool in (self._heights, self._valid):
            if spool is not None:
                spool.close()


def new_scan(info: RasterInfo, has_digest: bool, steps: FixedSteps | None = None) -> HeightScan:
    return HeightScan(info.dtype, steps, HeightDigest(info.n_cols) if has_digest else None)


def take(
    scan: HeightScan, region: Region, found: Even | Window, info: RasterInfo, reporter: Reporter
) -> None:
    """Add a window, or an even region, to a scan of a whole raster, and report it."""
    if not isinstance(found, Even):
        scan.update(*found, region.row, region.col)
    elif scan.digest is not None and found.is_valid:  # of every sample
        for part in region.tiles(_SIDE, _SIDE):
            heights = found.heights(part.shape, np.dtype(scan.dtype))
            scan.update(heights, np.ones(part.shape, dtype=np.bool_), part.row, part.col)
    else:
        n_samples = region.n_rows * region.n_cols
        scan.update_even(found.value, n_samples, is_valid=found.is_valid)
    n_bytes = scan.n_samples * np.dtype(scan.dtype).itemsize
    reporter.report("scanning", scan.n_samples, info.n_rows * info.n_cols, n_bytes)


def _checksum(heights: NDArray[Any], valid: NDArray[np.bool_]) -> int:
    return crc32(np.packbits(valid).data, crc32(np.where(valid, heights, 0).data))


def changed(name: str, where: str = "") -> StorageError:
    """Return the error for a raster whose heights are not those that were scanned."""
    return StorageError(
        f"{name} changed{where} while it was compressed; expected a raster that stays as it is:"
        " compress a copy, or when it is finished. Nothing was written"
    )


def check_free_space(source: RasterSource, directory: Path, n_there: int = 0) -> None:
    """Raise if the temporary directory is too small; it already holds `n_there` bytes.

    The levels have a third of the raster's samples, of four bytes at most. With voids they take
    less, which leaves room for fills. Even regions take none.
    """
    info, n_samples = source.info, 0
    whole = Region(0, 0, info.n_rows, info.n_cols)
    for part, even in even_parts(whole, _UNEVEN_SIDE, source.even):
        n_samples += part.n_rows * part.n_cols * (even is None)
    n_bytes = n_samples * np.dtype(info.dtype).itemsize
    needed = n_samples * 4 // 3 + (n_bytes if source.is_striped else 0) - n_there
    free = shutil.disk_usage(directory).free
    if needed > free:
        sizes = size_of(needed), size_of(free)
        if sizes[0] == sizes[1]:
            sizes = count_of(needed, "byte"), count_of(free, "byte")
        raise StorageError(
            f"temporary data need about {sizes[0]}, {directory.parent} has {sizes[1]} free:"
            " name another directory with `temp_dir`"
        )
