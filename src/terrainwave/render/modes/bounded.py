"""Frames of pieces whose errors are bounds: morphs and skirts that keep within τ pixels."""

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError
from terrainwave.render.modes.mode import Frames, Mode, ModeNeeds
from terrainwave.render.scene.selection import NodeTable, Selection, View

# A block is drawn slightly before its parent's error reaches τ, and moves from there to its
# position.
MORPH_START = 1.25


class BoundedMode(Mode):
    """Mode whose pieces and pictures have guaranteed errors.

    With `orientation` errors count by the direction from which they are seen.
    """

    def __init__(self, needs: ModeNeeds, *, orientation: bool = False) -> None:
        super().__init__(needs)
        if orientation and self.error != "measured":
            raise InvalidArgumentError(
                f"found `orientation` and `error` {self.error!r}, expected `error` 'measured'"
            )
        self.is_oriented = orientation

    def split_error(self, tau: float) -> float:
        return tau / MORPH_START

    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        # The nearest first: hidden parts need not be shaded.
        order = np.argsort(selection.distances, kind="stable")
        nodes, distances = selection.nodes[order], selection.distances[order]
        tau = max(tau, 0.0)
        morphs, drawn, allowed = table.bounded_errors(view, nodes, tau, tau * MORPH_START)
        # A neighbour's error: within τ at the furthest point that it may share with this block, or
        # one that represents others.
        low, high = table.boxes(nodes, view.exaggeration)
        beside = tau * MORPH_START * _furthest(view, low, high) / view.least_gamma
        too_coarse = drawn[drawn > allowed]
        beside = np.maximum(beside, too_coarse.max(initial=0.0))
        beside = np.minimum(beside, drawn.max(initial=0.0))
        return Frames(
            nodes, distances, morphs, drawn + beside,
            selection.n_triangles, tau * MORPH_START * view.flatness, n_missing,
        )  # fmt: skip


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
