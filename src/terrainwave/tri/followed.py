"""What meshes that follow a camera are told, and say; the factor of τ that keeps to a budget."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError

# Open sides, where the raster goes on beyond its samples: top, left, bottom, right; here none is.
CLOSED = False, False, False, False

# Where there are too many vertices, τ is raised by steps; it sinks again by smaller ones.
_RISE, _RELIEF = 1.1, 1.02
# No view is shown coarser; what is around the eye has no error small enough.
_LARGEST = 1e6


class Eye(NamedTuple):
    """What errors on screen depend on.

    Parameters
    ----------
    position : ndarray of float64, shape (3,)
        In the units of the mesh.
    forward : ndarray of float64, shape (3,)
        Unit vector along the axis of the view.
    planes : ndarray of float64, shape (n_planes, 4)
        Inward planes of what is in view: n·p + w >= 0 inside. Without any, all is.
    focal : float
        Focal length in pixels, the paper's f = d_near s / r_near: half the picture's diagonal over
        the tangent of half its angle.
    slant : float
        Largest distance / depth in view, that of the picture's corners.
    z_scale : float
        Factor of heights.
    """

    position: NDArray[np.float64]
    forward: NDArray[np.float64]
    planes: NDArray[np.float64]
    focal: float
    slant: float
    z_scale: float = 1.0


class Followed(NamedTuple):
    """What marks say after they have followed a view.

    Parameters
    ----------
    threshold : float
        Errors on screen below this were merged, pixels: τ, or τ / λ with a morph.
    tau : float
        Pixels; above what was asked for if the budget demands it.
    within : float
        What the mesh keeps with measured errors, pixels: τ, or more while steps lag behind.
    n_vertices : int
        Roots that are not void.
    n_touched : int
        Nodes that marking looked at.
    n_changed : int
        Nodes that became a root or ceased to be one; 0 where marks have settled.
    """

    threshold: float
    tau: float
    within: float
    n_vertices: int
    n_touched: int
    n_changed: int


def check_update(tau: float, morph: float) -> None:
    """Check what meshes that follow a camera are asked for.

    Raises
    ------
    InvalidHeightsError
        If τ is not > 0 or λ is not >= 1.
    """
    if not tau > 0 or not morph >= 1:
        raise InvalidHeightsError(f"found tau {tau} and morph {morph}, expected > 0 and >= 1")


def check_budget(max_vertices: int | None, least: int, what: str) -> None:
    """Refuse a budget below the vertices that there always are, one per `what`.

    Raises
    ------
    InvalidHeightsError
        If it is smaller.
    """
    if max_vertices is not None and max_vertices < least:
        raise InvalidHeightsError(
            f"found max_vertices {max_vertices}, expected at least one per {what}: {least}"
        )


class Pressure:
    """A factor of τ, at least 1, that rises at once and sinks slowly.

    Attributes
    ----------
    factor : float
    """

    def __init__(self) -> None:
        self.factor = 1.0

    def relieve(self) -> None:
        """Let it sink by a step; once a frame."""
        self.factor = max(self.factor / _RELIEF, 1.0)

    def rise(self) -> bool:
        """Raise it by a step; false if it is as large as it may be."""
        if self.factor >= _LARGEST:
            return False
        self.factor *= _RISE
        return True
