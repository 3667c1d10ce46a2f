"""Work of `terrainwave demo`."""

import os
from dataclasses import dataclass, replace
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
from terrainwave.verification.metrics import ErrorReport

# Metres.
BOUNDS = (0.0, 1.0, 3.0, 10.0)

# Bound of the drawn result, large enough to be visible.
_DRAWN_BOUND = 10.0


@dataclass(frozen=True)
class DemoResult:
    """Sizes and measured errors, by bound in metres."""

    n_rows: int
    n_cols: int
    n_bytes: int
    files: dict[float, terrainwave.CompressResult]
    errors: dict[float, ErrorReport]
    picture: str

    def row(self, bound: float) -> list[str]:
        """Return the row of the printed table."""
        file, errors = self.files[bound], self.errors[bound]
        return [
            f"{bound:g} m",
            f"{file.n_bytes:,}",
            f"{file.bits_per_sample:.3f}",
            f"{self.n_bytes / file.n_bytes:.2f}",
            f"{errors.max_error:g} m",
            f"{errors.rmse:.3f} m",
        ]


def run_demo(
    directory: str | os.PathLike[str], *, progress: ProgressCallback | None = None
) -> DemoResult:
    """Compress matplotlib's elevation model of the Jacksboro fault at each of `BOUNDS`.

    Writes ``jacksboro.tif``, a .twz per bound and ``demo.png`` to `directory`, replacing those of
    an earlier run; a failed run leaves nothing.

    Raises
    ------
    BoundViolationError
        If a decoded height is outside its bound.
    StorageError
        If `directory` cannot be written.
    TerrainwaveError
        If matplotlib is missing.
    """
    folder = Path(directory)
    heights, info = _load_heights()
    with scratch_directory(_existing(folder), folder.name) as scratch:
        new = scratch / "new"
        new.mkdir()
        result = _fill(new, heights, info, progress)
        with storage_errors(f"cannot write {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
            for path in new.iterdir():
                os.replace(path, folder / path.name)
    return replace(result, picture=os.fspath(folder / Path(result.picture).name))


def _existing(folder: Path) -> Path:
    """Return the folder or its nearest existing parent, which is on the same file system."""
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def _fill(
    folder: Path, heights: np.ndarray, info: RasterInfo, progress: ProgressCallback | None
) -> DemoResult:
    """Write the demo's files to an empty folder."""
    original = folder / "jacksboro.tif"
    with RasterSink(original, info) as sink:
        sink.write(0, 0, heights, np.ones(heights.shape, dtype=bool))
    files, errors = {}, {}
    for bound in BOUNDS:
        path = _file(folder, bound)
        files[bound] = terrainwave.compress(original, path, max_error=bound, progress=progress)
        report = terrainwave.verify(path, original)
        if not report.ok or report.errors is None:
            raise BoundViolationError(f"{path}: {'; '.join(report.problems)}")
        errors[bound] = report.errors
    picture = folder / "demo.png"
    _draw(folder, picture)
    return DemoResult(
        info.n_rows, info.n_cols, original.stat().st_size, files, errors, os.fspath(picture)
    )


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


def _draw(folder: Path, picture: Path) -> None:
    """Draw original, decoded heights and their error side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.4), layout="constrained", dpi=110)
    axes = figure.subplots(1, 3)
    heights = []
    titles = "original", f"decoded, every height within {_DRAWN_BOUND:g} m"
    for axis, bound, title in zip(axes[:2], (0.0, _DRAWN_BOUND), titles, strict=True):
        with terrainwave.open(_file(folder, bound)) as terrain:
            terrain.plot(axis)
            heights.append(terrain.read().astype(np.int32))
        axis.set_title(title)
    error = heights[1] - heights[0]
    image = axes[2].imshow(error, cmap="RdBu_r", vmin=-_DRAWN_BOUND, vmax=_DRAWN_BOUND)
    axes[2].set_aspect(axes[0].get_aspect())
    axes[2].set_title("decoded − original")
    axes[2].set_axis_off()
    figure.colorbar(image, ax=axes[2], shrink=0.8, label="m")
    with storage_errors(f"cannot write {picture}"):
        figure.savefig(picture)


def _file(folder: Path, bound: float) -> Path:
    return folder / f"jacksboro_{bound:g}m.twz"
