"""Frames of pieces whose errors are bounds: morphs and skirts that keep the promise of τ pixels."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError
from terrainwave.progress import ProgressCallback
from terrainwave.render.frame import Frame
from terrainwave.render.modes.mode import Frames, Mode
from terrainwave.render.selection import NodeTable, Selection, View

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

# A block is drawn a little before its parent's error reaches τ, and moves from there to its place.
MORPH_START = 1.25
# Pixels per metre that count as none.
_LEAST_SCALE = 1e-12


class BoundedMode(Mode):
    """A mode whose pieces state errors that hold, and so do its pictures.

    Parameters
    ----------
    orientation : bool
        Errors count by the direction they are seen from (`kernels.oriented_distance`).
    """

    def __init__(
        self,
        terrain: "TerrainFile",
        frame: Frame,
        *,
        error: str = "measured",
        progress: ProgressCallback | None = None,
        orientation: bool = False,
    ) -> None:
        super().__init__(terrain, frame, error=error, progress=progress)
        if orientation and error != "measured":
            raise InvalidArgumentError(
                f"found `orientation` and `error` {error!r}, expected `error` 'measured'"
            )
        self.is_oriented = orientation

    def split_error(self, tau: float) -> float:
        """Return the error on screen above which pieces are split, for τ asked for."""
        return tau / MORPH_START

    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        """Return how to draw a selection that was split at `tau`, from `split_error`.

        Pieces are split at τ / MORPH_START, so that what is drawn may use up to τ.
        """
        # The nearest first: what they hide need not be shaded.
        order = np.argsort(selection.distances, kind="stable")
        nodes, distances = selection.nodes[order], selection.distances[order]
        tau = max(tau, 0.0)
        low, high = table.boxes(nodes, view.exaggeration)
        # A morph leads out of the box, by as much as the parent's surface is away.
        spread = np.zeros((len(nodes), 3))
        spread[:, 2] = table.morphs[nodes] * view.exaggeration
        scales = np.maximum(view.scales(low - spread, high + spread), _LEAST_SCALE)
        allowed = tau * MORPH_START / scales  # metres of error within τ
        morphs = self._morphs(table, view, nodes, allowed, tau)
        drawn = (table.errors[nodes] + morphs * table.morphs[nodes]) * view.exaggeration
        # A neighbour's error: within τ at the furthest point that it may share with this block,
        # or one that stands in for others.
        beside = tau * MORPH_START * _furthest(view, low, high) / view.least_gamma
        too_coarse = drawn[drawn > allowed]
        beside = np.maximum(beside, too_coarse.max(initial=0.0))
        beside = np.minimum(beside, drawn.max(initial=0.0))
        return Frames(
            nodes, distances, morphs, drawn + beside,
            selection.n_triangles, tau * MORPH_START, n_missing,
        )  # fmt: skip

    def _morphs(
        self,
        table: NodeTable,
        view: View,
        nodes: NDArray[np.int32],
        allowed: NDArray[np.float64],
        tau: float,
    ) -> NDArray[np.float64]:
        """Return each block's share of its parent's surface.

        1 where the parent would just be drawn (its error at τ / MORPH_START), 0 where that error
        reaches τ; and no more than leaves error + share · distance to the parent within τ, which
        keeps the promise exactly: between vertices both surfaces are linear.
        """
        if tau <= 0:
            return np.zeros(len(nodes))
        z_scale = view.exaggeration
        parents = table.parents[nodes]
        has_parent = parents >= 0
        above = np.where(has_parent, parents, 0)
        screen = table.errors[above] * z_scale * np.minimum(table.scales(view, above), 1e12)
        start, end = tau, tau * MORPH_START
        shares = np.clip((end - screen) / (end - start), 0.0, 1.0)
        spread = table.morphs[nodes] * z_scale
        errors = table.errors[nodes] * z_scale
        budget = np.clip((allowed - errors) / np.maximum(spread, 1e-12), 0.0, 1.0)
        return np.where(has_parent, np.minimum(shares, budget), 0.0)


def _furthest(
    view: View, low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return d: boxes with points in these have at least `least_gamma` / d pixels a metre."""
    eye = view.camera.eye
    away = np.maximum(np.abs(low - eye), np.abs(high - eye))
    if not view.is_oriented:
        distances: NDArray[np.float64] = np.linalg.norm(away, axis=1)
        return distances
    # (h² + v²) / h is largest at one of the ends of h.
    nearest = np.maximum(np.maximum(low - eye, eye - high), 0.0)
    least, most = (np.hypot(*sides[:, :2].T) for sides in (nearest, away))
    ends = [h + away[:, 2] ** 2 / np.maximum(h, 1e-9) for h in (least, most)]
    return np.maximum(*ends)
