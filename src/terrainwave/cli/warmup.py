"""Work of `terrainwave warmup`: run each kind of work once, so that its kernels are compiled."""

import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

import terrainwave
from terrainwave.coding.native_library import SWITCH, is_used
from terrainwave.container.targets.publication import system_scratch
from terrainwave.errors import StorageError, TerrainwaveError, TerrainwaveWarning
from terrainwave.names import (
    DEFAULT_METHOD,
    EFFORTS,
    MESH_KINDS,
    METHODS,
    SMALLEST_METHOD,
    WARMUP_TASKS,
)
from terrainwave.raster_io.geotiff.sink import RasterSink
from terrainwave.raster_io.raster_info import SUPPORTED_DTYPES, RasterInfo

# Rows and columns: several levels of the smallest blocks, with the edge inside a block.
_SHAPE = (200, 220)
_BLOCK = 32
_METRES = 30.0


def compile_kernels(tasks: Sequence[str] = ()) -> list[str]:
    """Run small jobs of some `TASKS`, by default all; return the skipped ones with reasons."""
    # Imported here: numba.
    from terrainwave.coding.jit import all_compiled, place_of_kernels
    from terrainwave.coding.kernel_places import kept

    place = place_of_kernels()
    if place.kept_in is None:
        raise StorageError(f"no kernel was kept: {place.reason}")
    left_out = []
    with system_scratch() as folder, warnings.catch_warnings(), all_compiled(), _without_library():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        _compress(folder)
        for task in tasks or TASKS:
            try:
                TASKS[task](folder)
            except TerrainwaveError as error:  # a package or driver is not installed
                left_out.append(f"{task}: {error}")
    n_kept, n_lost, reason = kept()
    if n_lost:
        raise StorageError(
            f"{n_lost} of {n_kept + n_lost} kernels that were compiled are not kept: {reason}"
        )
    return left_out


@contextmanager
def _without_library() -> Iterator[None]:
    """Let kernels do what the native library does, too: it leaves some work to some of them."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "0"
    is_used.cache_clear()
    try:
        yield
    finally:
        is_used.cache_clear()
        del os.environ[SWITCH]
        if before is not None:
            os.environ[SWITCH] = before


def keep_kernels_in(path: Path, tasks: Sequence[str], *, quiet: bool) -> int:
    try:
        path.mkdir(parents=True, exist_ok=True)
        for folder in (path, *filter(Path.is_dir, path.iterdir())):  # it may have some already
            tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise StorageError(
            f"{path}: no kernel was kept ({error.strerror or error}); expected a folder that you"
            " can write"
        ) from error
    command = [sys.executable, "-m", "terrainwave", "warmup", "--for", ",".join(tasks)]
    package = str(Path(terrainwave.__file__).parents[1])
    settings = os.environ | {
        "NUMBA_CACHE_DIR": str(path),
        "PYTHONPATH": os.pathsep.join(filter(None, (package, os.environ.get("PYTHONPATH")))),
    }
    settings.pop("NUMBA_CACHE_LOCATOR_CLASSES", None)
    status = subprocess.run(command + ["--quiet"] * quiet, env=settings).returncode
    if status < 0:
        raise StorageError(
            f"{path}: no more kernels are kept: signal {-status} ended their process"
        )
    if status:  # the process has printed the reason
        raise click.exceptions.Exit(status)
    return sum(1 for _ in path.rglob("*.nbc"))


def _hills(dtype: str, quantum: int = 1) -> NDArray[np.generic]:
    """Return heights like a GeoTIFF's of the Earth; whole numbers are multiples of `quantum`."""
    rows, cols = np.mgrid[: _SHAPE[0], : _SHAPE[1]]
    heights = 100 + 40 * np.sin(rows / 19) * np.cos(cols / 17) + 5 * np.sin(rows * cols / 70)
    heights = heights * (1e6 if dtype == "int32" else 1)
    return (heights if np.dtype(dtype).kind == "f" else heights // quantum * quantum).astype(dtype)


def _rasters(folder: Path) -> list[tuple[Path, float]]:
    rasters = [(_write(folder / "row.tif", _hills("int16")[:1]), 0.0)]
    for dtype in SUPPORTED_DTYPES:
        bound = 0.5 if np.dtype(dtype).kind == "f" else 0.0
        # Steps of two: quanta other than 1 use another kernel.
        for name, quantum in ((dtype, 1), (f"{dtype}-void", 2)):
            rasters.append((_write(folder / f"{name}.tif", _hills(dtype, quantum)), bound))
    return rasters


def _write(path: Path, heights: NDArray[np.generic]) -> Path:
    has_void = path.stem.endswith("-void")
    is_float = heights.dtype.kind == "f"
    n_rows, n_cols = heights.shape
    valid = np.ones(heights.shape, dtype=np.bool_)
    valid[3:9, 3:9] = not has_void
    if is_float and has_void:
        heights[~valid] = np.nan
    info = RasterInfo(
        n_rows, n_cols, str(heights.dtype), nodata=0 if has_void and not is_float else None,
        crs="EPSG:32632", units="m", transform=(_METRES, 0.0, 5e5, 0.0, -_METRES, 5e6),
        mask_kind="none" if not has_void else "nan" if is_float else "nodata",
    )  # fmt: skip
    with RasterSink(path, info) as sink:
        sink.write(0, 0, heights, valid)
    return path


def _compress(folder: Path) -> None:
    for path, bound in _rasters(folder):
        is_common = path.stem.startswith(("int16", "float32"))
        for method in METHODS.values() if is_common else (DEFAULT_METHOD, SMALLEST_METHOD):
            efforts = EFFORTS if method.effort and path.stem == "int16-void" else EFFORTS[1:2]
            for max_error in dict.fromkeys((bound, 3.0)):
                for effort in efforts:
                    terrainwave.compress(
                        path, folder / f"{path.stem}-{method.name}.twz", max_error=max_error,
                        method=method.name, effort=effort, block=_BLOCK, overwrite=True,
                    )  # fmt: skip


def _files(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.glob("*.twz")
        if not path.stem.startswith(("mesh", "row", "patched"))
    )


def _read(folder: Path) -> None:
    for path in _files(folder):
        with terrainwave.open(path) as terrain:
            for resampling in ("nearest", "bilinear", "average"):
                terrain.read(out_shape=(50, 60), resampling=resampling)
                terrain.read(out_shape=(400, 400), resampling=resampling)
            left, bottom, right, top = terrain.bounds
            terrain.sample([((left + right) / 2, (bottom + top) / 2)])
            if METHODS[terrain.header.method].is_cuttable:
                terrain.read_early(quality=1.0)
        terrainwave.decompress(path, path.with_suffix(".tif"), overwrite=True)
        terrainwave.decompress(path, path.with_suffix(".r16"), overwrite=True)


def _verify(folder: Path) -> None:
    for path in _files(folder):
        stem, _, method = path.stem.rpartition("-")
        if method == DEFAULT_METHOD.name:
            terrainwave.verify(path, folder / f"{stem}.tif", mesh=True)


def _patch(folder: Path) -> None:
    stem = "int16-void"
    heights = _hills("int16", 2)
    upside_down = heights.max() + heights.min() - heights[:60, :70]
    new = _write(folder / "patched-void.tif", upside_down.astype(np.int16))
    for method in METHODS.values():
        if method.is_patchable:
            path = folder / f"patched-{method.name}.twz"
            shutil.copyfile(folder / f"{stem}-{method.name}.twz", path)
            terrainwave.patch(path, new)
            with terrainwave.open(path) as terrain:
                terrain.read()


def _mesh(folder: Path) -> None:
    for stem in ("int16", "int16-void", "float32-void"):
        path = folder / f"{stem}-{DEFAULT_METHOD.name}.twz"
        # Kinds that files of every method can have; here they follow no zero trees.
        meshes: list[Any] = [*MESH_KINDS, terrainwave.Zerotree(labels="layer")]
        for mesh in meshes:
            target = folder / "mesh.twz"
            terrainwave.store_meshes(path, target, mesh=mesh, overwrite=True)
            with terrainwave.open(target) as terrain:
                terrain.mesh(optimise=0)
                terrain.mesh(level=-2)
            terrainwave.verify(target, mesh=True)
        with terrainwave.open(path) as terrain:
            terrain.mesh(max_error=5.0, optimise=0)
            terrain.mesh(max_error=5.0)
            terrain.mesh(max_triangles=2000)


def _render(folder: Path) -> None:
    from terrainwave.render.gpu.canvas import Canvas
    from terrainwave.render.look.style import Style
    from terrainwave.render.modes import MODES
    from terrainwave.render.window.pictures import choose_camera

    for stem in ("int16-void", "float32"):
        path = folder / f"{stem}-{DEFAULT_METHOD.name}.twz"
        # Stepwise marks use kernels of their own, which vertex-texture shares.
        for mode in (*MODES, "stepwise"):
            for error in ("measured", "paper"):
                with (
                    terrainwave.open(path) as terrain,
                    Canvas(
                        terrain,
                        (320, 240),
                        mode="dynamic" if mode == "stepwise" else mode,
                        error=error,
                        stepwise=mode == "stepwise",
                    ) as canvas,
                ):
                    frame = canvas.scene.frame
                    whole = choose_camera(frame, canvas.viewport)
                    canvas.picture(whole, Style(), max_pixel_error=4.0)
                    canvas.picture(whole, Style(), max_pixel_error=0.5)


def _nothing_more(_folder: Path) -> None:
    """Do nothing: every task compresses its files anyway."""


TASKS: dict[str, Callable[[Path], None]] = dict(
    zip(WARMUP_TASKS, (_nothing_more, _read, _verify, _patch, _mesh, _render), strict=True)
)
