"""Work of `terrainwave demo`."""

import os
from pathlib import Path

import numpy as np

import terrainwave
from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import scratch_directory
from terrainwave.errors import BoundViolationError
from terrainwave.extras import need
from terrainwave.progress import ProgressCallback
from terrainwave.raster_io.geotiff.sink import RasterSink
from terrainwave.raster_io.raster_info import RasterInfo

# Metres. The largest is visible in the picture.
BOUNDS = (0.0, 1.0, 3.0, 10.0)
HEADER = ["bound", "bytes", "bits/sample", "GeoTIFF/twz", "max error", "RMSE"]


def run_demo(
    directory: str | os.PathLike[str], *, progress: ProgressCallback | None = None
) -> tuple[str, list[list[str]]]:
    """Compress matplotlib's elevation model of the Jacksboro fault at each of `BOUNDS`.

    Replaces the raster, a .twz per bound and ``demo.png`` in `directory`, or leaves nothing.
    Returns the raster in words, and a row below `HEADER` for each bound.
    """
    folder = Path(directory)
    heights, info = _load_heights()
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    with scratch_directory(existing, folder.name) as scratch:
        new = scratch / "new"
        new.mkdir()
        original = new / "jacksboro.tif"
        with RasterSink(original, info) as sink:
            sink.write(0, 0, heights, np.ones(heights.shape, dtype=bool))
        n_bytes = original.stat().st_size
        rows = [_row(original, n_bytes, bound, progress) for bound in BOUNDS]
        _draw(new, n_bytes)
        with storage_errors(f"cannot write {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
            for path in new.iterdir():
                os.replace(path, folder / path.name)
    size = f"{info.n_rows} x {info.n_cols} heights"
    return f"{size}, GeoTIFF (DEFLATE): {n_bytes:,} bytes", rows


def _row(
    original: Path, n_bytes: int, bound: float, progress: ProgressCallback | None
) -> list[str]:
    path = _file(original.parent, bound)
    file = terrainwave.compress(original, path, max_error=bound, progress=progress)
    report = terrainwave.verify(path, original)
    if not report.ok or report.errors is None:
        raise BoundViolationError(f"{path}: {'; '.join(report.problems)}")
    return [
        f"{bound:g} m",
        f"{file.n_bytes:,}",
        f"{file.bits_per_sample:.3f}",
        f"{n_bytes / file.n_bytes:.2f}",
        f"{report.errors.max_error:g} m",
        f"{report.errors.rmse:.3f} m",
    ]


def _load_heights() -> tuple[np.ndarray, RasterInfo]:
    cbook = need("matplotlib.cbook", extra="demo", purpose="the demo")
    data = cbook.get_sample_data("jacksboro_fault_dem.npz")
    heights = data["elevation"].astype(np.int16)
    n_rows, n_cols = heights.shape
    # The file's dx, dy are pixel sizes in degrees, xmin and ymax the outer corner.
    dx, dy, left, top = (float(data[name]) for name in ("dx", "dy", "xmin", "ymax"))
    info = RasterInfo(
        n_rows, n_cols, "int16", crs="EPSG:4326", transform=(dx, 0.0, left, 0.0, -dy, top),
        units="m", area_or_point="Area",
    )  # fmt: skip
    return heights, info


def _draw(folder: Path, n_bytes: int) -> None:
    from matplotlib.figure import Figure

    bound = BOUNDS[-1]
    figure = Figure(figsize=(13.5, 4.4), layout="constrained", dpi=110)
    axes = figure.subplots(1, 3)
    decoded = _file(folder, bound)
    titles = {
        _file(folder, 0.0): f"original: GeoTIFF (DEFLATE), {n_bytes:,} bytes",
        decoded: f"every height within {bound:g} m: .twz, {decoded.stat().st_size:,} bytes",
    }
    heights = []
    for axis, (path, title) in zip(axes, titles.items(), strict=False):
        with terrainwave.open(path) as terrain:
            terrain.plot(axis)
            heights.append(terrain.read().astype(np.int32))
        axis.set_title(title)
    errors = heights[1] - heights[0]
    metres, counts = np.unique(errors, return_counts=True)
    axes[2].bar(metres, 100 * counts / errors.size, width=0.7)
    axes[2].set(
        title=f"errors: {metres[0]} to {metres[-1]} m, none beyond".replace("-", "−"),
        xlabel="decoded − original, m", ylabel="% of the heights",
    )  # fmt: skip
    with storage_errors(f"cannot write {folder}"):
        figure.savefig(folder / "demo.png")


def _file(folder: Path, bound: float) -> Path:
    return folder / f"jacksboro_{bound:g}m.twz"
