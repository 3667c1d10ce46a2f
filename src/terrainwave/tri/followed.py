"""Input and output of meshes that follow a camera; the factor of τ that keeps to a budget."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError

# No open sides, where the raster continues beyond its samples: top, left, bottom, right.
CLOSED = False, False, False, False

# With too many vertices τ is raised by steps; it is lowered again by smaller ones.
_RISE, _RELIEF = 1.1, 1.02
# Coarsest view; around the eye no error is small enough.
_LARGEST = 1e6


class Eye(NamedTuple):
    """Camera: the input of errors on screen."""

    position: NDArray[np.float64]  # shape (3,); in the units of the mesh
    forward: NDArray[np.float64]  # shape (3,); unit vector along the axis of the view
    # shape (n_planes, 4); inward planes of the view: n·p + w >= 0 inside. Without planes everything
    # is in view.
    planes: NDArray[np.float64]
    # focal length in pixels, the paper's f = d_near s / r_near: half the picture's diagonal over
    # the tangent of half its angle
    focal: float
    slant: float  # largest distance / depth in view, that of the picture's corners
    z_scale: float = 1.0  # factor of heights


class Followed(NamedTuple):
    """Statistics after marks have followed a view."""

    threshold: float  # errors on screen below this were merged, pixels: τ, or τ / λ with a morph
    tau: float  # pixels; above the requested one if the budget requires it
    within: float  # error kept with measured errors, in pixels: τ, or more while steps lag behind
    n_vertices: int  # roots that are not void
    n_touched: int  # nodes visited by marking
    n_changed: int  # nodes that became a root or ceased to be one; 0 once marks are stable


def check_update(tau: float, morph: float) -> None:
    """Check the options of meshes that follow a camera.

    Raises
    ------
    InvalidHeightsError
        If τ is not > 0 or λ is not >= 1.
    """
    if not tau > 0 or not morph >= 1:
        raise InvalidHeightsError(f"found tau {tau} and morph {morph}, expected > 0 and >= 1")


def check_budget(max_vertices: int | None, least: int, what: str) -> None:
    """Raise `InvalidHeightsError` for a budget below the least vertices, one per `what`."""
    if max_vertices is not None and max_vertices < least:
        raise InvalidHeightsError(
            f"found max_vertices {max_vertices}, expected at least one per {what}: {least}"
        )


class Pressure:
    """Factor of τ, at least 1, that rises at once and falls slowly."""

    def __init__(self) -> None:
        self.factor = 1.0

    def relieve(self) -> None:
        """Lower it by a step; once a frame."""
        self.factor = max(self.factor / _RELIEF, 1.0)

    def rise(self) -> bool:
        """Raise it by a step; return False at its maximum."""
        if self.factor >= _LARGEST:
            return False
        self.factor *= _RISE
        return True
