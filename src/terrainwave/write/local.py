"""The three passes of `compress` over a raster, in threads of this process."""

import os
from dataclasses import dataclass, field
from pathlib import Path

from terrainwave.container.digests import TileDigests
from terrainwave.container.targets.kept import Kept
from terrainwave.grid.crew import Crew
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.progress import Reporter
from terrainwave.raster_io.source import RasterSource
from terrainwave.write.job import Job
from terrainwave.write.passes.coding import Coded, encode
from terrainwave.write.passes.proof import prove
from terrainwave.write.passes.resuming import is_by_heights, same_heights
from terrainwave.write.passes.windows import Windows, check_free_space, scan_windows


@dataclass
class LocalPasses:
    """Passes over `source`, in the threads of `executor`; large data in `directory`.

    Work that `kept` has from an earlier run is not repeated.
    """

    source: RasterSource
    directory: Path
    executor: Crew
    reporter: Reporter
    has_digest: bool = False
    kept: Kept = field(default_factory=Kept)
    _windows: Windows | None = None

    @property
    def windows(self) -> Windows:
        """Return the raster's windows, once it has been scanned."""
        assert self._windows is not None
        return self._windows

    def scan(self, steps: FixedSteps | None = None) -> HeightScan:
        """Return range, validity and vertical quantum of every sample, and a digest if wanted."""
        check_free_space(self.source, self.directory, self.kept.n_bytes)
        by_heights = is_by_heights(self.kept)
        # Records that may be of other heights are not used.
        kept = Kept() if by_heights else self.kept
        self._windows = Windows(self.source, self.directory, kept)
        first = self._windows.n_scanned()
        scan = scan_windows(
            self.source.info,
            self._windows.scan(self.executor, first),
            self.reporter,
            has_digest=self.has_digest or by_heights,
            steps=steps,
            kept=kept,
            first=first,
        )
        if by_heights and scan.digest is not None:
            same_heights(self.kept, scan.digest.text)
        return scan

    def encode(self, job: Job) -> Coded:
        """Code all units into one spool per segment."""
        return encode(job, self.windows, self.directory, self.executor, self.reporter, self.kept)

    def prove(self, path: str | os.PathLike[str] | bytes, job: Job) -> tuple[float, TileDigests]:
        """Decode the file, compare every sample; return the largest error and digests of tiles."""
        return prove(path, job, self.windows, self.executor, self.reporter, self.kept)

    def close(self) -> None:
        if self._windows is not None:
            self._windows.close()
