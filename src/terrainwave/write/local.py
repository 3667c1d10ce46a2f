"""The three passes of `compress` over a raster, in threads of this process."""

import os
from dataclasses import dataclass

from terrainwave.container.digests import TileDigests
from terrainwave.container.targets.kept import Kept
from terrainwave.grid.quantum import HeightScan
from terrainwave.grid.steps import FixedSteps
from terrainwave.write.job import Job
from terrainwave.write.passes.bench import Bench
from terrainwave.write.passes.coding import Coded, encode
from terrainwave.write.passes.proof import prove
from terrainwave.write.passes.resuming import is_by_heights, same_heights
from terrainwave.write.passes.windows import Windows, check_free_space


@dataclass
class LocalPasses:
    """Passes over a raster that do not repeat the work of an earlier run."""

    bench: Bench
    has_digest: bool = False
    _windows: Windows | None = None

    @property
    def windows(self) -> Windows:
        """Return the raster's windows, once it has been scanned."""
        assert self._windows is not None
        return self._windows

    def scan(self, steps: FixedSteps | None = None) -> HeightScan:
        """Return range, validity and vertical quantum of every sample, and a digest if wanted."""
        source, kept = self.bench.source, self.bench.kept
        check_free_space(source, self.bench.directory, kept.n_bytes)
        by_heights = is_by_heights(kept)
        # Records that may be of other heights are not used.
        self._windows = Windows(source, self.bench.directory, Kept() if by_heights else kept)
        scan = self._windows.scan(
            self.bench.executor, self.bench.reporter, self.has_digest or by_heights, steps
        )
        if by_heights and scan.digest is not None:
            same_heights(kept, scan.digest.text)
        return scan

    def encode(self, job: Job) -> Coded:
        """Code all units into one spool per segment."""
        return encode(job, self.windows, self.bench)

    def prove(self, path: str | os.PathLike[str] | bytes, job: Job) -> tuple[float, TileDigests]:
        """Decode the file, compare every sample; return the largest error and digests of tiles."""
        return prove(path, job, self.windows, self.bench)

    def close(self) -> None:
        if self._windows is not None:
            self._windows.close()
