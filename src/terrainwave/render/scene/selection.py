"""Selection of blocks: recursive from the roots by screen error (Yusov & Turlapov 2010, §2.8).

A node is a piece known to the viewer. Its cost per frame depends on the view: the recursion ends at
nodes outside the frustum, and at those fine enough.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Block
from terrainwave.render.scene.camera import Camera, Viewport, focal_length, gamma_guaranteed, slant
from terrainwave.render.scene.frustum import frustum_planes
from terrainwave.render.scene.horizon import FLOORS, Floors, Horizon, floor_at
from terrainwave.render.scene.select_kernels import (
    NodeArrays,
    Sight,
    bounded_errors,
    fine_nodes,
    node_scales,
    select_nodes,
    wanted_nodes,
)

_FIRST_CAPACITY = 256
_MOST_SCALE = 1e12  # pixels per metre, if the eye is in a box


class Piece(NamedTuple):
    """Unit of drawing: a block, triangulated within the tolerance number `variant`.

    0 is the block's own; blocks of the finest level also have coarser variants (see `patches`).
    """

    level: int
    row: int
    col: int
    variant: int = 0

    @property
    def block(self) -> Block:
        return Block(self.level, self.row, self.col)


class NodeInfo(NamedTuple):
    """Properties of a piece from the index: its box in local metres, its error in metres.

    `spacing` is the distance of its samples, local metres.
    """

    piece: Piece
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    error: float
    spacing: float


class Built(Protocol):
    """Result of `Mode.build`; the mode's store knows its other contents. Lengths in metres."""

    @property
    def children(self) -> list[NodeInfo]: ...  # read in the worker, so that drawing never reads
    @property
    def n_triangles(self) -> int: ...
    @property
    def base(self) -> float: ...  # the height of its z = 0
    @property
    def error(self) -> float: ...  # a guaranteed bound for its surface
    @property
    def morph(self) -> float: ...  # largest distance between its surface and its parent's
    @property
    def floors(self) -> Floors | None: ...  # lower limits; None if it must not hide others


@dataclass(frozen=True)
class View:
    """Camera, size of the picture, and the definition of errors on screen."""

    camera: Camera
    viewport: Viewport
    max_pixel_error: float = 1.0  # τ, pixels; 0 selects the finest blocks everywhere
    # returns γ of a camera and a viewport; by default one that is valid in the corners too
    gamma_of: Callable[[Camera, Viewport], float] = gamma_guaranteed
    exaggeration: float = 1.0  # factor of heights
    is_oriented: bool = False  # errors, being vertical, count less when seen steeply from above
    # errors count by each block's position in the picture (`node_scale`), not by one γ for all of
    # it
    is_exact: bool = False
    # errors below this multiple of τ are accepted if a piece has a sample for each pixel
    # (`Scene.view`); 1: none are
    flatness: float = 1.0
    # the camera's: pieces below it are hidden; by default none are
    horizon: Horizon = field(default_factory=Horizon.none, compare=False)

    @cached_property
    def gamma(self) -> float:
        return self.gamma_of(self.camera, self.viewport)

    @cached_property
    def least_gamma(self) -> float:
        """Return the smallest γ for errors of blocks, in pixels · distance / error.

        In `pixels_per_metre` K counts as 1 or more, and depths are at most distances. Oriented, K /
        p_D is h / (p_D² r), h the horizontal distance and r that of a line through the picture, at
        most its corners': distance is then (h² + v²) / h.
        """
        if not self.is_exact:
            return self.gamma
        length = focal_length(self.camera, self.viewport)
        return length / slant(self.camera, self.viewport) if self.is_oriented else length

    @cached_property
    def lens(self) -> NDArray[np.float64]:
        """Return the argument of `select_kernels.pixels_per_metre`; see there."""
        forward = self.camera.forward
        if not self.is_exact:
            return np.array([self.gamma, 1.0, 1.0, *forward])
        scale = focal_length(self.camera, self.viewport)
        up, right = self.viewport.height / 2 / scale, self.viewport.width / 2 / scale
        sine, cosine = forward[2], math.hypot(*forward[:2])
        rise = (right * sine) ** 2 + (cosine + abs(sine) * up) ** 2
        return np.array([scale, slant(self.camera, self.viewport) ** 2, rise, *forward])

    def sight(self, tau: float | None = None) -> Sight:
        """Return the argument of kernels, for another τ than the view's."""
        tau = self.max_pixel_error if tau is None else tau
        length = focal_length(self.camera, self.viewport)
        return Sight(
            self.planes, self.camera.eye, self.exaggeration, self.lens, self.is_oriented,
            np.array([tau, tau * self.flatness, length]), *self.horizon,
        )  # fmt: skip

    @cached_property
    def planes(self) -> NDArray[np.float64]:
        return frustum_planes(self.camera, self.viewport)


class Selection(NamedTuple):
    """Nodes to draw with their distances, nearest part of the box to the eye; their triangles."""

    nodes: NDArray[np.int32]
    distances: NDArray[np.float64]
    n_triangles: int


class NodeTable:
    """Known pieces in arrays, for the kernels. Used by one thread."""

    def __init__(self) -> None:
        self._numbers: dict[Piece, int] = {}
        self.pieces: list[Piece] = []
        self._of_level: dict[int, list[int]] = {}
        self._floors: dict[int, Floors] = {}  # of pieces in the store
        self._free: list[int] = []  # numbers of removed pieces
        self.roots = np.empty(0, dtype=np.int32)
        self._allocate(_FIRST_CAPACITY)

    def _allocate(self, capacity: int) -> None:
        self.low = np.zeros((capacity, 3))
        self.high = np.zeros((capacity, 3))
        self.errors = np.zeros(capacity)
        self.spacings = np.zeros(capacity)
        self.children = np.full((capacity, 4), -1, dtype=np.int32)
        self.parents = np.full(capacity, -1, dtype=np.int32)
        self.keys = np.zeros((capacity, 4), dtype=np.int64)  # the pieces, as numbers
        self.is_known = np.zeros(capacity, dtype=np.bool_)
        self.is_resident = np.zeros(capacity, dtype=np.bool_)
        self.n_triangles = np.zeros(capacity, dtype=np.int64)
        self.bases = np.zeros(capacity)
        self.morphs = np.zeros(capacity)
        self._stack = np.empty(capacity, dtype=np.int32)
        self._nodes = np.empty(capacity, dtype=np.int32)
        self._distances = np.empty(capacity)

    def __len__(self) -> int:
        return len(self.pieces)

    def _grow(self) -> None:
        old, n = dict(vars(self)), len(self)
        self._allocate(2 * len(self.errors))
        for name in (
            "low", "high", "errors", "spacings", "children", "parents", "keys", "is_known",
            "is_resident", "n_triangles", "bases", "morphs",
        ):  # fmt: skip
            getattr(self, name)[:n] = old[name][:n]

    def find(self, piece: Piece) -> int | None:
        return self._numbers.get(piece)

    def add(self, info: NodeInfo, parent: int = -1) -> int:
        """Add a piece; return its number."""
        number = self._numbers.get(info.piece)
        if number is not None:
            return number
        if self._free:
            number = self._free.pop()
            self.pieces[number] = info.piece
        else:
            number = len(self)
            if number == len(self.errors):
                self._grow()
            self.pieces.append(info.piece)
        self._numbers[info.piece] = number
        self.low[number], self.high[number] = info.low, info.high
        self.errors[number], self.spacings[number] = info.error, info.spacing
        self.keys[number] = info.piece
        self._of_level.setdefault(info.piece.level, []).append(number)
        self.parents[number] = parent
        if parent < 0:
            self.roots = np.append(self.roots, np.int32(number))
        return number

    def add_children(self, parent: int, infos: list[NodeInfo]) -> None:
        if self.is_known[parent]:
            return
        for place, info in enumerate(infos):
            self.children[parent, place] = self.add(info, parent)
        self.is_known[parent] = True

    def describe(self, node: int, built: Built) -> None:
        """Update a piece that is now in the store from its built form."""
        self.is_resident[node] = True
        # A larger error than assumed may leave the box.
        further = max(built.error - float(self.errors[node]), 0.0)
        self.low[node, 2] -= further
        self.high[node, 2] += further
        self.errors[node], self.n_triangles[node] = built.error, built.n_triangles
        self.bases[node], self.morphs[node] = built.base, built.morph
        if built.floors is not None:
            self._floors[node] = built.floors

    def forget(self, node: int) -> None:
        self.is_resident[node] = False
        self._floors.pop(node, None)

    @property
    def n_known(self) -> int:
        return len(self._numbers)

    def forget_children(self, used: Sequence[NDArray[np.int32]]) -> None:
        """Remove pieces below those that are not in the store, except needed ones.

        Nodes of `used` stay, with all above them and their siblings. Building a piece lists its
        children again. Numbers of removed pieces are reused.
        """
        n = len(self)
        parents, is_resident = self.parents[:n], self.is_resident[:n]
        is_needed = is_resident.copy()
        for nodes in used:
            is_needed[nodes] = True
        above = np.flatnonzero(is_needed)
        while len(above):
            above = np.unique(parents[above])
            above = above[above >= 0]
            above = above[~is_needed[above]]
            is_needed[above] = True
        keeps_children = is_resident.copy()
        keeps_children[parents[is_needed & (parents >= 0)]] = True
        is_kept = (parents < 0) | keeps_children[parents]
        gone = np.flatnonzero(~is_kept)
        self.children[:n][~keeps_children] = -1
        self.is_known[:n][~keeps_children] = False
        for numbers in (self.n_triangles, self.bases, self.morphs, self.errors):
            numbers[gone] = 0
        self.parents[gone] = -1
        for number in gone.tolist():
            del self._numbers[self.pieces[number]]
        self._free += gone.tolist()
        for level, numbers_of_level in self._of_level.items():
            self._of_level[level] = [number for number in numbers_of_level if is_kept[number]]

    def floors(self, nodes: NDArray[np.int32]) -> Floors:
        """Return the known floors of nodes, shape (n,)."""
        found = [self._floors[node] for node in nodes.tolist() if node in self._floors]
        return np.array(found, dtype=FLOORS)

    def floor_at(self, x: float, y: float) -> float:
        """Return a lower limit of the ground at a point, from the finest loaded piece.

        Metres, without exaggeration; -inf if unknown, near voids and outside.
        """
        found, nodes = -math.inf, self.roots.tolist()
        while nodes:
            node = nodes.pop()
            height = floor_at(self._floors[node], x, y) if node in self._floors else None
            if height is not None:
                found, nodes = height, self.children[node][self.children[node] >= 0].tolist()
        return found

    def stand_in(
        self, view: View, nodes: NDArray[np.int32], tau: float, before: NDArray[np.int32]
    ) -> bool:
        """Return whether one of `nodes` is drawn instead of finer ones, some in `before`."""
        are_short = self.is_known[nodes] & (self.children[nodes] >= 0).any(axis=1)
        are_short &= ~self.are_fine(view, nodes, tau)
        if not are_short.any():
            return False
        is_short = np.zeros(len(self), dtype=np.bool_)
        is_short[nodes[are_short]] = True
        above = self.parents[before]
        while len(above := above[above >= 0]):
            if is_short[above].any():
                return True
            above = self.parents[above]
        return False

    def _arrays(self) -> NodeArrays:
        return NodeArrays(
            self.low, self.high, self.errors, self.spacings, self.children, self.is_known
        )

    def boxes(
        self, nodes: NDArray[np.int32], exaggeration: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and highest corners of nodes as drawn, shape (n, 3) each."""
        scale = np.array([1.0, 1.0, exaggeration])
        return self.low[nodes] * scale, self.high[nodes] * scale

    def distances(self, view: View, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return the least distances of nodes from the eye, local metres."""
        low, high = self.boxes(nodes, view.exaggeration)
        eye = view.camera.eye
        beside: NDArray[np.float64] = np.maximum(np.maximum(low - eye, eye - high), 0.0)
        away: NDArray[np.float64] = np.linalg.norm(beside, axis=1)
        return away

    def scales(self, view: View, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return pixels on screen per metre of nodes' errors; inf if the eye is in their box."""
        scales = np.empty(len(nodes))
        node_scales(nodes, self._arrays(), view.sight(), scales)
        return scales

    def on_screen(
        self, view: View, nodes: NDArray[np.int32], errors: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return bounds on screen, pixels, of errors in metres: by default those of the nodes.

        Finite, and 0 for errors of 0, also if the eye is in a node's box.
        """
        errors = self.errors[nodes] if errors is None else errors
        return errors * view.exaggeration * np.minimum(self.scales(view, nodes), _MOST_SCALE)

    def are_fine(self, view: View, nodes: NDArray[np.int32], tau: float) -> NDArray[np.bool_]:
        """Return which nodes need not be split in a view."""
        out = np.empty(len(nodes), dtype=np.bool_)
        fine_nodes(nodes, self._arrays(), view.sight(tau), out)
        return out

    def bounded_errors(
        self, view: View, nodes: NDArray[np.int32], start: float, end: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return shares of parents' surfaces, drawn errors and errors within `end` pixels, metres.

        A share is 1 where the parent would just be drawn (its error at `start`), 0 where that error
        reaches `end`. It is limited so that error + share · distance to the parent is within `end`,
        which guarantees the bound exactly: between vertices both surfaces are linear.
        """
        out = np.empty((len(nodes), 3))
        sight = view.sight()
        bounded_errors(nodes, self._arrays(), self.morphs, self.parents, sight, start, end, out)
        return out[:, 0], out[:, 1], out[:, 2]

    def select(self, view: View, tau: float | None = None) -> Selection:
        """Return the resident blocks that show the view within τ if they are loaded.

        Parents replace children that are not resident.
        """
        n_out, n_triangles = select_nodes(
            self.roots, self._arrays(), self.is_resident, self.n_triangles, view.sight(tau),
            self._stack, self._nodes, self._distances,
        )  # fmt: skip
        return Selection(
            self._nodes[:n_out].copy(), self._distances[:n_out].copy(), int(n_triangles)
        )

    def wanted(
        self, view: View, max_blocks: int, tau: float | None = None, camera: Camera | None = None
    ) -> NDArray[np.int32]:
        """Return the nodes that a view needs, ancestors first, at most `max_blocks`.

        `camera` is another camera than the view's own.
        """
        if camera is not None and camera is not view.camera:
            view = replace(view, camera=camera, horizon=Horizon.none())
        out = np.empty(max_blocks, dtype=np.int32)
        # Near roots first.
        roots = self.roots
        if len(roots) > 1:
            middle = (self.low[roots] + self.high[roots]) / 2
            away = np.linalg.norm(middle - view.camera.eye, axis=1)
            roots = roots[np.argsort(away, kind="stable")]
        n_out = wanted_nodes(roots, self._arrays(), view.sight(tau), out)
        return out[:n_out]

    def coarse_nodes(self, most: int) -> NDArray[np.int32]:
        """Return the known nodes of the coarsest levels, no more than `most`, by level."""
        nodes: list[int] = []
        for level in sorted(self._of_level):
            if len(nodes) + len(self._of_level[level]) > most:
                break
            nodes += self._of_level[level]
        return np.array(nodes, dtype=np.int32)

    def lowest_priority(self, view: View, keep: NDArray[np.bool_]) -> NDArray[np.int32]:
        """Return resident nodes that may be evicted, the least needed first.

        Those without resident children that are not in `keep`, by w = u·V / d, u and d towards
        their centres (Zhang et al. 2012, eq. 13).
        """
        n = len(self)
        inner = np.zeros(n, dtype=np.bool_)
        parents = self.parents[:n][self.is_resident[:n]]
        inner[parents[parents >= 0]] = True
        nodes = np.flatnonzero(self.is_resident[:n] & ~keep & ~inner).astype(np.int32)
        low, high = self.boxes(nodes, view.exaggeration)
        away = (low + high) / 2 - view.camera.eye
        ranks = away @ view.camera.forward / np.maximum((away * away).sum(axis=1), 1e-12)
        return nodes[np.argsort(ranks, kind="stable")]


class ErrorGovernor:
    """Raises τ if triangles or time would exceed their limits, and lowers it again.

    `max_triangles` and `target_ms`, None if unlimited, are those of a frame.
    """

    _LARGEST = 64.0

    def __init__(self, max_triangles: int, target_ms: float | None = None) -> None:
        self.max_triangles = max_triangles
        self.target_ms = target_ms
        self.factor = 1.0

    def after_frame(self, frame_ms: float) -> None:
        if self.target_ms is None:
            return
        ratio = frame_ms / self.target_ms
        if ratio > 1.1:
            self.factor = min(self.factor * min(ratio**0.5, 1.25), self._LARGEST)
        elif ratio < 0.8:
            self.factor = max(self.factor / 1.05, 1.0)

    def select(
        self, table: NodeTable, view: View, tau: float | None = None
    ) -> tuple[Selection, float]:
        """Return a selection within the budget, and its τ; `tau` is required, or the view's."""
        tau = (view.max_pixel_error if tau is None else tau) * self.factor
        selection = table.select(view, tau)
        while selection.n_triangles > self.max_triangles and tau < 1e6:
            tau = max(tau, 0.05) * 1.3
            selection = table.select(view, tau)
        return selection, tau
