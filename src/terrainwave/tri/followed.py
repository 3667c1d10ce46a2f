"""Meshes that follow a camera, their input and output; the factor of τ that keeps to a budget."""

from abc import ABC, abstractmethod
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.tri.scratch import Scratch

Frame = TypeVar("Frame")

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


# The numbers of touched and changed vertices, and the largest error on screen of those that need
# further division, 0 without any.
Marked = tuple[int, int, float]


class FollowingMesh(ABC, Generic[Frame]):
    """A mesh that follows a camera."""

    _n_vertices = 0

    def __init__(
        self,
        # (a, b, c, d, e, f): x = a col + b row + c, y = d col + e row + f
        sample_matrix: tuple[float, ...],
        scratch: Scratch | None,  # memory that meshes drawn by one thread share
    ) -> None:
        self.matrix = tuple(float(value) for value in sample_matrix)
        self.is_mirrored = self.matrix[0] * self.matrix[4] < self.matrix[1] * self.matrix[3]
        self._scratch = scratch or Scratch()
        self._pressure = Pressure()

    @property
    @abstractmethod
    def least_vertices(self) -> int:
        """Return the smallest number of vertices in a view."""

    def follow(
        self,
        eye: Eye,
        tau: float,
        *,
        morph: float = 1.0,
        max_vertices: int | None = None,
        is_stepwise: bool = False,
    ) -> Followed:
        """Go on to a view, which suffices if the GPU moves vertices itself.

        `tau` is the largest error on screen in pixels, > 0. Vertices move to where they merge while
        their errors are τ / λ … τ, λ = `morph` >= 1. τ is raised until at most `max_vertices`, at
        least `least_vertices`, are left; what is around the eye is divided in any case.
        `is_stepwise`, of a `DynamicMesh`: change by one height at most, as in the paper, except for
        the first view and if the budget requires more; the mesh may lag behind the view.
        """
        limit = np.iinfo(np.int64).max if max_vertices is None else max_vertices
        pressure = self._pressure
        pressure.relieve()
        n_touched, n_changed, largest = self._mark(
            eye, tau * pressure.factor / morph, limit, is_stepwise
        )
        while self._n_vertices > limit and pressure.rise():
            *more, largest = self._mark(eye, tau * pressure.factor / morph, limit, False)
            n_touched, n_changed = n_touched + more[0], n_changed + more[1]
        used = tau * pressure.factor
        return Followed(
            used / morph, used, max(used, largest), self._n_vertices, n_touched, n_changed
        )

    @abstractmethod
    def _mark(self, eye: Eye, threshold: float, limit: int, is_stepwise: bool) -> Marked:
        """Go on to a view, to few more than `limit` vertices."""

    @abstractmethod
    def draw(self, eye: Eye, followed: Followed) -> Frame:
        """Return the mesh of a view; `followed` is what `follow` returned for this eye."""

    def update(self, eye: Eye, tau: float, **options: Any) -> Frame:
        """Return the mesh for a view: `follow`, whose arguments these are, and `draw`."""
        return self.draw(eye, self.follow(eye, tau, **options))
