"""Pass A: a raster's windows, scanned once and read again."""

import shutil
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import count_of, size_of
from terrainwave.container.targets.kept import Kept
from terrainwave.errors import StorageError
from terrainwave.grid.digest import HeightDigest
from terrainwave.grid.quadtree import Region
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.progress import Reporter
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.temporary import MEMORY_LIMIT, Spool
from terrainwave.write.pyramid import SourceWindows

SCAN = "scan"  # its record in what is kept
# Heights, validity, row and column of the first sample.
Window = tuple[NDArray[Any], NDArray[np.bool_], int, int]


class Windows(SourceWindows):
    """The source's windows, spooled during the scan where its own are slow to read.

    A narrow window of a striped raster decodes whole strips, once for every window beside it. And a
    small raster is kept in memory: each sample is read two or three times.
    """

    def __init__(self, source: RasterSource, directory: Path, kept: Kept) -> None:
        self._source = source
        self._shape = source.info.n_rows, source.info.n_cols
        self._directory = directory
        self._heights: Spool | None = None
        self._voids: Spool | None = None
        if source.is_striped or (source.is_file and source.info.n_bytes <= MEMORY_LIMIT):
            path = kept.path("heights")
            self._heights = Spool(self._shape, source.info.dtype, directory, path=path)
        self._kept = kept

    @property
    def is_kept(self) -> bool:
        """Say whether windows that were scanned need not be scanned again."""
        return self._heights is None or self._heights.is_kept

    def scan(self, first: int = 0) -> Iterator[Window]:
        """Yield (heights, validity, row, column), once over the raster in the source's order.

        The windows before `first` have been scanned by an earlier run.
        """
        if first and self._heights is not None and self._kept.get("voids") is not None:
            self._voids = self._new_voids()
        for region in islice(self._source.blocks(), first, None):
            heights, valid = self._source.read(*region)
            if self._heights is not None:
                self._heights.write(region, heights)
                if self._voids is None and not valid.all():
                    self._voids = self._new_voids()
                    self._kept.put("voids", {})
                if self._voids is not None:
                    self._voids.write(region, ~valid)
            yield heights, valid, region.row, region.col

    def _new_voids(self) -> Spool:
        return Spool(self._shape, np.bool_, self._directory, path=self._kept.path("voids"))

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return raw heights and validity of a window."""
        if self._heights is None:
            return self._source.read(row, col, n_rows, n_cols)
        region = Region(row, col, n_rows, n_cols)
        if self._voids is None:
            return self._heights.read(region), np.ones(region.shape, dtype=np.bool_)
        return self._heights.read(region), ~self._voids.read(region)

    def close(self) -> None:
        """Delete the spools."""
        for spool in (self._heights, self._voids):
            if spool is not None:
                spool.close()


def scan_windows(
    info: RasterInfo,
    windows: Iterable[Window],
    reporter: Reporter,
    *,
    has_digest: bool,
    steps: FixedSteps | None = None,
    kept: Kept | None = None,
) -> HeightScan:
    """Return range, validity, vertical quantum and, if wanted, a digest of a raster's windows.

    With `kept`, `windows` are those that it does not know yet.
    """
    scan = HeightScan(info.dtype, steps, HeightDigest(info.n_cols) if has_digest else None)
    total = info.n_rows * info.n_cols
    kept = kept or Kept()
    state = kept.get(SCAN) or {"n_windows": 0}
    if state["n_windows"]:
        scan.take_state(state["scan"])
    n_windows = state["n_windows"]
    for window in windows:
        scan.update(*window)
        n_windows += 1
        kept.tick(SCAN, lambda: {"n_windows": n_windows, "scan": scan.to_state()})  # noqa: B023
        n_bytes = scan.n_samples * np.dtype(info.dtype).itemsize
        reporter.report("scanning", scan.n_samples, total, n_bytes)
    kept.put(SCAN, {"n_windows": n_windows, "scan": scan.to_state()})
    return scan


def check_free_space(info: RasterInfo, directory: Path, is_striped: bool, n_there: int = 0) -> None:
    """Refuse to begin what the temporary directory cannot hold; `n_there` bytes are there."""
    n_samples = info.n_rows * info.n_cols
    needed = n_samples * 4 // 3 + (info.n_bytes if is_striped else 0) - n_there
    free = shutil.disk_usage(directory).free
    if needed > free:
        sizes = size_of(needed), size_of(free)
        if sizes[0] == sizes[1]:
            sizes = count_of(needed, "byte"), count_of(free, "byte")
        raise StorageError(
            f"temporary data need about {sizes[0]}, {directory.parent} has {sizes[1]} free:"
            " name another directory with `temp_dir`"
        )
