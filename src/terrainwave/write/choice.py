"""Which method `auto` is for a raster: the fast one, unless another saves enough.

That follows from the raster alone: windows chosen by position are coded with each method, as if
they were rasters of their own. So it is the same for any number of threads and on any cluster.
Why there are three thresholds is in docs/decisions/0013.
"""

from collections.abc import Callable

from terrainwave.codec.refiner import FittingRefiner, GroupSpec, Heights, Mask, Refiner, Sides
from terrainwave.codec.registry import refiner_by_name
from terrainwave.codec.windows import spread_windows
from terrainwave.grid.quadtree import Region
from terrainwave.names import AUTO_METHODS, EFFORTS
from terrainwave.write.job import Job

# A slower method must take so much less in windows, in percent.
_LEAST_SAVED = 8
# And it must save a byte in so many samples, 1/16 bit per sample: the smallest files are a few
# hundredths of a bit, and a tenth of them is not worth being read five times slower.
_MOST_SAMPLES_PER_BYTE = 128
# On rough ground the share is less, but what is saved is not: this is enough without it, 1/8 bit
# per sample. What it costs is time, and that is by the sample too.
_ENOUGH_SAMPLES_PER_BYTE = 64
# No slower method has ever saved more than a fifth of windows; on ground that is not rough none was
# worth it below 4 bits per sample. What takes less is not tried, which takes time, most to compile.
_MOST_SAVED = 20
_MOST_BITS_OF_SMOOTH = 4
# Windows are coded with one try for each plane, which is faster and less to compile.
_EFFORT = EFFORTS.index("fast")
# Samples a side of a window, samples of the raster for one, and the fewest and most of them.
_WINDOW, _SHARE = 129, 1 << 18
_LEAST_WINDOWS, _MOST_WINDOWS = 2, 8

Reader = Callable[[int, Region], Heights]
MaskReader = Callable[[int, Region], Mask]


def prepared(job: Job, heights: Reader, mask: MaskReader) -> tuple[Job, Refiner, bytes]:
    """Return a job whose method is settled, its refiner, and the tables fitted to the raster.

    `heights` and `mask` return targets and validity of a region of a level.
    """
    refiner, tables = _fitted(job, heights, mask)
    if not job.options.is_auto:
        return job, refiner, tables
    settled = job.with_method(AUTO_METHODS[0])
    if job.n_valid:
        windows = _windows(job, heights, mask)
        n_samples = sum(target.size for _, target, _ in windows)
        assert isinstance(refiner, FittingRefiner)
        # Both start from trained statistics, so that neither has learned what the other has not.
        n_bytes = _n_bytes(refiner.unlearned(), windows)
        is_tried = _may_be_worth(n_bytes, n_samples, refiner.is_rough)
        for method in AUTO_METHODS[1:] if is_tried else ():
            n_saved = n_bytes - _n_bytes(refiner_by_name(method.name), windows)
            if _is_worth(n_saved, n_bytes, n_samples):
                settled = job.with_method(method)
                refiner, tables = _fitted(settled, heights, mask)
                break
    return settled, refiner, tables


def _may_be_worth(n_bytes: int, n_samples: int, is_rough: bool) -> bool:
    """Return whether windows take enough for a slower method to save enough of it."""
    if not is_rough:
        return 8 * n_bytes >= _MOST_BITS_OF_SMOOTH * n_samples
    return _MOST_SAVED * _MOST_SAMPLES_PER_BYTE * n_bytes >= 100 * n_samples


def _is_worth(n_saved: int, n_bytes: int, n_samples: int) -> bool:
    """Return whether a slower method saves enough of the bytes that windows take."""
    is_share = 100 * n_saved >= _LEAST_SAVED * n_bytes
    limit = _MOST_SAMPLES_PER_BYTE if is_share else _ENOUGH_SAMPLES_PER_BYTE
    return limit * n_saved >= n_samples


def _fitted(job: Job, heights: Reader, mask: MaskReader) -> tuple[Refiner, bytes]:
    refiner = refiner_by_name(job.options.coding.name)
    if not isinstance(refiner, FittingRefiner) or not job.n_valid:
        return refiner, b""
    fitted = refiner.fitted(
        job.grid, job.parameters.step, heights, mask, may_have_reach=job.options.may_be_new
    )
    return fitted, fitted.parameters


def _windows(job: Job, heights: Reader, mask: MaskReader) -> list[tuple[GroupSpec, Heights, Mask]]:
    """Return windows of the full grid as root blocks."""
    grid, parameters = job.grid, job.parameters
    n_windows = min(max(grid.n_rows * grid.n_cols // _SHARE, _LEAST_WINDOWS), _MOST_WINDOWS)
    found = []
    for target, valid in zip(*spread_windows(grid, heights, mask, _WINDOW, n_windows), strict=True):
        region = Region(0, 0, *target.shape)
        spec = GroupSpec(
            grid.k_max, region, region, None, Sides(False, False, False, False),
            parameters.step, parameters.z_min, parameters.z_max, parameters.forbidden, 1,
            _EFFORT, wants_labels=False,
        )  # fmt: skip
        found.append((spec, target, valid))
    return found


def _n_bytes(refiner: Refiner, windows: list[tuple[GroupSpec, Heights, Mask]]) -> int:
    """Return the bytes that windows take with a refiner."""
    return sum(len(refiner.encode(spec, None, target, mask)[0]) for spec, target, mask in windows)
