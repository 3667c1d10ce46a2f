"""Blocks with meshes of only their zero trees (Yusov & Turlapov 2010, §2.4)."""

import math
from typing import Any

import numpy as np

from terrainwave.render.modes.adaptive import Adaptive
from terrainwave.render.modes.mode import NO_PROMISE, Frames, ModeNeeds
from terrainwave.render.scene.selection import NodeTable, Piece, Selection, View


class Loose(Adaptive):
    """The blocks of `Adaptive`, with meshes without a guarantee above the finest level.

    They are selected as if they had their guaranteed ones. The error of a mesh is measured when it
    is built: `Frames.tau` is the largest of these on screen, often far above the requested τ, and
    infinite if the eye is in the box of a piece.
    """

    name = "loose"
    is_loose = True

    def __init__(self, needs: ModeNeeds, *, orientation: bool = False) -> None:
        super().__init__(needs, orientation=orientation)
        self._drawn_errors: dict[Piece, float] = {}

    @property
    def has_limit(self) -> bool:
        """Return False: errors of meshes are only known once they are built."""
        return False

    def keep(self, piece: Piece, built: Any) -> None:
        self._drawn_errors[piece] = built.drawn_error

    def drop(self, piece: Piece) -> None:
        del self._drawn_errors[piece]

    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        frames = super().frames(table, view, selection, tau, n_missing)
        errors = np.array([self._drawn_errors[table.pieces[node]] for node in frames.nodes])
        above = np.maximum(errors - table.errors[frames.nodes], 0.0)
        skirts = frames.skirts + (above + above.max(initial=0.0)) * view.exaggeration
        on_screen = table.on_screen(view, frames.nodes, errors).max(initial=0.0)
        # Nothing is known from within the box of a piece.
        kept = float(on_screen) if on_screen < NO_PROMISE else math.inf
        return frames._replace(skirts=skirts, tau=max(frames.tau, kept))
