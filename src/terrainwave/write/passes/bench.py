"""The raster, threads and folder that the passes of a run share."""

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from terrainwave.container.header import Header
from terrainwave.container.targets.kept import Kept
from terrainwave.errors import InvalidHeightsError
from terrainwave.file.raster import raster_source
from terrainwave.grid.crew import Crew
from terrainwave.grid.quadtree import Block
from terrainwave.progress import Reporter
from terrainwave.raster_io.source import RasterSource
from terrainwave.read.decoder import TreeDecoder
from terrainwave.write.job import Job
from terrainwave.write.pyramid import Base, Pyramid, SourceWindows, SubtreeRegion

if TYPE_CHECKING:
    from terrainwave.mesh.blocks import BlockMesher


class AskedRaster(NamedTuple):
    """A raster, or mosaic of several, and how to read it; arguments of `compress`."""

    src: Any
    band: int = 1
    nodata: float | str | None = None
    georeference: bool = True
    heights_are: str | None = None

    def open(self, *, warn: bool = False) -> RasterSource:
        """Open it; notes were issued where the run began."""
        return raster_source(
            self.src, band=self.band, nodata=self.nodata, georeference=self.georeference,
            heights_are=self.heights_are, warn=warn,
        )  # fmt: skip

    def shared(self) -> "AskedRaster":
        """Return the raster as other machines open it."""
        sources = self.src if isinstance(self.src, list | tuple) else [self.src]
        if not all(isinstance(source, str | os.PathLike) for source in sources):
            raise InvalidHeightsError(
                f"found a {type(self.src).__name__}; expected the path or URL of a raster that"
                " every worker of the cluster can read"
            )
        paths = [os.fspath(source) for source in sources]
        paths = [os.path.abspath(path) if os.path.exists(path) else path for path in paths]
        return self._replace(src=paths[0] if len(paths) == 1 else paths)


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

    def meshes(
        self,
        header: Header,
        decoder: TreeDecoder,
        errors: Mapping[Block, int],
        levels: Iterable[int] | None = None,
    ) -> tuple["BlockMesher", dict[Block, bytes]]:
        """Return the mesher of a file without meshes, and the sections that it will have.

        With `levels`, only those of blocks on these.
        """
        from terrainwave.mesh.sections import make_meshes  # most runs make none

        return make_meshes(
            header.grid,
            decoder,
            lambda block: errors.get(block, 0),
            header.mesh_tolerance,
            has_voids=header.has_voids,
            kind=header.mesh,
            executor=self.executor,
            on_samples=self.counter("making meshes"),
            levels=levels,
        )
