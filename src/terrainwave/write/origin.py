"""Comparison of a file with the one that `compress` would make now, without making it."""

import os
from dataclasses import replace
from typing import Any

from terrainwave.container.metadata import EARLIER, ORIGIN, without_origin
from terrainwave.errors import TerrainwaveError
from terrainwave.file import TerrainFile
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.raster_io.raster_info import earlier_files
from terrainwave.write.compress_options import Options
from terrainwave.write.job import metadata_of, origin_of, settled
from terrainwave.write.passes.bench import AskedRaster
from terrainwave.write.passes.windows import new_scan, take


def difference(
    path: str | os.PathLike[str],
    src: Any,
    *,
    band: int = 1,
    nodata: float | str | None = None,
    georeference: bool = True,
    heights_are: str | None = None,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> str | None:
    """Return why `path` differs from the file that `compress` makes of `src`; None if equal.

    The reason completes a sentence: "it …". The raster is read only if all else is equal.
    """
    asked = Options(**options)
    try:
        with TerrainFile(path, threads=1) as terrain:
            header = terrain.header
    except TerrainwaveError:
        return "it is no .twz file that can be read"
    origin = header.metadata.get(ORIGIN)
    if not isinstance(origin, dict):
        return "it does not say what it was made of"
    if origin.get("options") != asked.to_metadata():
        return "it was made with other options"
    with AskedRaster(src, band, nodata, georeference, heights_are).open() as source:
        info = source.info
        size = info.n_rows, info.n_cols, info.dtype
        metadata = without_origin(header.metadata)
        metadata.pop("software", None)
        metadata.pop("moved", None)
        files = earlier_files({EARLIER: metadata.pop(EARLIER, None)})
        kind = metadata.pop("heights_are", None)
        told = metadata_of(replace(info, heights_are=None))
        if size != (header.n_rows, header.n_cols, header.dtype) or metadata != told:
            return "it was made of another raster"
        if files != (source.earlier.files if source.earlier else ()):
            return "it was made of another .twz file"
        scan, reporter = new_scan(info, has_digest=True), Reporter(progress)
        for region in source.blocks():
            take(scan, region, source.read(*region), info, reporter)
        info = source.with_meaning(scan.minimum, scan.maximum)[0]
        if info.heights_are != kind:
            return "its numbers mean something else"
    if origin != origin_of(asked, scan):
        return "it was made of other heights"
    # Another version may have another default.
    if asked.max_error is None and not files and not asked.is_embedded:
        job, _ = settled(asked, scan, info)
        if job.raw_bound != header.max_error:
            return "it was made with another default bound"
    return None
