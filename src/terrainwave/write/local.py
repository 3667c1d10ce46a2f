"""The three passes of `compress` over a raster, in threads of this process."""

import os
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.progress import Reporter
from terrainwave.raster_io.source import RasterSource
from terrainwave.write.job import Job
from terrainwave.write.passes.coding import Coded, encode
from terrainwave.write.passes.proof import prove
from terrainwave.write.passes.windows import Windows, check_free_space, scan_windows


@dataclass
class LocalPasses:
    """The passes over `source`, in the threads of `executor`; large data in `directory`."""

    source: RasterSource
    directory: Path
    executor: Executor
    reporter: Reporter
    has_digest: bool = False
    _windows: Windows | None = None

    @property
    def windows(self) -> Windows:
        """Return the raster's windows; there are some once it has been scanned."""
        assert self._windows is not None
        return self._windows

    def scan(self, steps: FixedSteps | None = None) -> HeightScan:
        """Return range, validity and vertical quantum of every sample, and a digest if wanted."""
        check_free_space(self.source, self.directory)
        self._windows = Windows(self.source, self.directory)
        return scan_windows(
            self.source.info,
            self._windows.scan(),
            self.reporter,
            has_digest=self.has_digest,
            steps=steps,
        )

    def encode(self, job: Job) -> Coded:
        """Code all units into one spool per segment."""
        return encode(job, self.windows, self.directory, self.executor, self.reporter)

    def prove(self, path: str | os.PathLike[str] | bytes, job: Job) -> float:
        """Decode the file from disk and compare every sample; return the largest error."""
        return prove(path, job, self.windows, self.executor, self.reporter)

    def close(self) -> None:
        """Delete temporary data."""
        if self._windows is not None:
            self._windows.close()
