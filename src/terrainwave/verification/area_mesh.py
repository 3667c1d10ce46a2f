"""Check of one `Mesh` over an area of the full grid: a surface, within its error everywhere."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Region
from terrainwave.verification.checked_mesh import Deviation, deviation
from terrainwave.verification.on_grid import (
    QuantaScale,
    mesh_problems,
    must_be_covered,
    surface_of_mesh,
)

# Relative tolerance for decimal errors as float64.
_SLACK = 1e-9
_STRIP_SAMPLES = 1 << 24

ReadOriginal = Callable[[Region], tuple[NDArray[np.generic], NDArray[np.bool_]]]


def area_problems(
    terrain: Any,
    mesh: Any,
    region: Region,
    max_error: float | None,
    read: ReadOriginal | None = None,
) -> tuple[list[str], float]:
    """Return the problems of a `Mesh` of `region`, and the largest distance of samples from it.

    `max_error` is None for the stored meshes. Without `read`, errors are measured from the decoded
    heights, and may exceed the stated ones by the file's own bound.
    """
    ruler, problems, worst = QuantaScale(terrain), [], 0
    if max_error is not None and mesh.error > max_error * (1 + _SLACK):
        problems.append(f"it states an error of {mesh.error:g}")
    level = terrain.n_levels - 1 if max_error is None else None
    problems += mesh_problems(terrain, mesh, region, level)
    surface, stated = surface_of_mesh(terrain, mesh, region), ruler.in_sixteenths(mesh.error)
    limit = stated * (1 + _SLACK) + ruler.slack + (0 if read else ruler.coded)
    for strip in region.tiles(max(_STRIP_SAMPLES // region.n_cols, 2), region.n_cols):
        # One more row at the end: quads are covered between rows.
        last = min(strip.row + strip.n_rows + 1, region.row + region.n_rows)
        strip = strip._replace(n_rows=last - strip.row)
        raw, valid = (read or terrain.read_with_mask)(strip)
        place = strip.row - region.row, 0
        errors = deviation(surface, ruler.sixteenths(raw, valid), valid, limit, place)
        what = "heights" if read else "decoded heights"
        problems += error_problems(ruler, errors, stated, strip, what)
        problems += missing_samples(errors, must_be_covered(valid), strip)
        worst = max(worst, errors.worst)
    return problems, ruler.physical(worst)


def error_problems(
    ruler: QuantaScale,
    errors: Deviation,
    most: float,
    region: Region,
    what: str,
    of: str = "stated error",
) -> Iterator[str]:
    if errors.n_beyond:
        yield (
            f"{errors.n_beyond} {what} are further from it than the {of}"
            f" {ruler.physical(most):g}; the worst, at row"
            f" {region.row + errors.row}, column {region.col + errors.col}, by"
            f" {ruler.physical(errors.worst):g}"
        )


def missing_samples(errors: Deviation, wanted: NDArray[np.bool_], region: Region) -> Iterator[str]:
    missing = wanted & ~errors.is_covered
    if missing.any():
        row, col = np.argwhere(missing)[0].tolist()
        yield (
            f"{np.count_nonzero(missing)} valid samples are not covered, one at row"
            f" {region.row + row}, column {region.col + col}"
        )
