"""What the passes of a run over a raster work with."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from terrainwave.container.targets.kept import Kept
from terrainwave.grid.crew import Crew
from terrainwave.progress import Reporter
from terrainwave.write.job import Job
from terrainwave.write.pyramid import Base, Pyramid, SourceWindows, SubtreeRegion


@dataclass(frozen=True)
class Bench:
    """A raster, a directory for large temporary data, threads, and work of an earlier run.

    `source` is a `RasterSource`, or has windows as one (`SourceWindows`) and an `info`.
    """

    source: Any
    directory: Path
    executor: Crew
    reporter: Reporter = field(default_factory=partial(Reporter, None))
    kept: Kept = field(default_factory=Kept)

    def counter(
        self, stage: str, more: Callable[[], dict[str, int]] = dict
    ) -> Callable[[int], None]:
        """Return a counter of finished samples of the raster; `more` returns what it reports."""
        info = self.source.info
        total, itemsize = info.n_rows * info.n_cols, np.dtype(info.dtype).itemsize
        return self.reporter.counter(stage, total, itemsize, more)

    def pyramid(
        self,
        job: Job,
        source: SourceWindows | None = None,
        part: SubtreeRegion | None = None,
        base: Base | None = None,
    ) -> Pyramid:
        """Return the levels of a job's raster, or of a part; not yet made."""
        return Pyramid(
            source or self.source,
            job.quantizer,
            job.grid,
            kind=job.options.named_method.pyramid,
            has_voids=job.has_voids,
            directory=self.directory,
            executor=self.executor,
            part=part,
            base=base,
        )
