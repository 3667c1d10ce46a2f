"""One terrain as seen by moving cameras: what is here, what is wanted, what to draw. No GPU."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError, LimitExceededError, TerrainwaveError
from terrainwave.render.camera import Camera, Viewport, predict
from terrainwave.render.frame import Frame, frame_of
from terrainwave.render.frustum import may_see
from terrainwave.render.paging import Pager
from terrainwave.render.patches import Patch, PatchBuilder
from terrainwave.render.selection import ERRORS, ErrorGovernor, NodeTable, Piece, Selection, View

if TYPE_CHECKING:
    from terrainwave.terrain import Terrain

MODES = ("adaptive", "full")
DEFAULT_MAX_BYTES = 512 << 20
_UPLOADS_PER_FRAME = 4
_READY_PER_WORKER = 4
# Depth planes where all is drawn in parts: one for all of them.
_NEAREST_PART = 0.0
# A block is drawn a little before its parent's error reaches τ, and moves from there to its place.
MORPH_START = 1.25
# Where what is needed does not fit, τ is raised by steps; it sinks again as the camera moves on.
_PRESSURE, _RELIEF = 1.1, 1.02


class Store(Protocol):
    """Where patches are kept to be drawn: the GPU, or a list in tests."""

    @property
    def max_blocks(self) -> int:
        """Return how many patches fit."""

    def put(self, node: int, patch: Patch) -> bool:
        """Keep a patch; false if there is no room."""

    def drop(self, node: int) -> None:
        """Forget a patch."""

    @property
    def n_bytes(self) -> int:
        """Return the bytes of what is kept."""


class Frames(NamedTuple):
    """What to draw: for each node its place, morph and skirt.

    Parameters
    ----------
    nodes : ndarray of int32, shape (n,)
    distances : ndarray of float64, shape (n,)
        From the eye to the nearest part of the box, metres.
    morphs : ndarray of float64, shape (n,)
        Share of the parent's surface, 0 … 1.
    skirts : ndarray of float64, shape (n,)
        Depth of skirts, local metres.
    n_triangles : int
    tau : float
        Pixels; above what was asked for if limits demand it.
    n_missing : int
        Wanted patches that are not here yet.
    """

    nodes: NDArray[np.int32]
    distances: NDArray[np.float64]
    morphs: NDArray[np.float64]
    skirts: NDArray[np.float64]
    n_triangles: int
    tau: float
    n_missing: int


@dataclass
class Timings:
    """CPU milliseconds of the last update by part."""

    page: float = 0.0
    select: float = 0.0


@dataclass
class _PatchInfo:
    """Per node what drawing needs of its patch, in arrays as long as the table's."""

    base: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    morph: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def reach(self, n: int) -> None:
        """Make room for node n - 1."""
        if len(self.base) < n:
            self.base = np.resize(self.base, 2 * n)
            self.morph = np.resize(self.morph, 2 * n)


class Scene:
    """A terrain with a store of patches.

    Parameters
    ----------
    terrain : Terrain
    store : Store
    mode : {"adaptive", "full"}
        Blocks by screen error, or all finest ones.
    error : {"measured", "paper"}
        Errors and γ: those that hold everywhere, or the paper's.
    exaggeration, radius : float, optional
        See `frame_of`.
    max_triangles : int
        Per frame; τ is raised beyond it.
    target_ms : float, optional
        Per frame; τ is raised where it takes longer.
    n_workers : int
        Threads that read, decode and build.

    Notes
    -----
    Used by one thread, but for the workers. A context manager.
    """

    def __init__(
        self,
        terrain: "Terrain",
        store: Store,
        *,
        mode: str = "adaptive",
        error: str = "measured",
        exaggeration: float = 1.0,
        radius: float | None = None,
        max_triangles: int = 20_000_000,
        target_ms: float | None = None,
        n_workers: int = 2,
    ) -> None:
        if mode not in MODES:
            raise InvalidHeightsError(f"found mode {mode!r}, expected one of {', '.join(MODES)}")
        if error not in ERRORS:
            raise InvalidHeightsError(f"found error {error!r}, expected one of {', '.join(ERRORS)}")
        self.terrain = terrain
        self.frame: Frame = frame_of(terrain, radius=radius, exaggeration=exaggeration)
        self.mode, self.error = mode, error
        self.store = store
        self.table = NodeTable()
        self.governor = ErrorGovernor(max_triangles, target_ms)
        self.timings = Timings()
        self.problems: dict[Piece, str] = {}
        self._builder = PatchBuilder(terrain, self.frame, error=error)
        self._info = _PatchInfo()
        for info in self._builder.roots():
            self.table.add(info)
        self._pager = Pager(
            self._builder.build, n_workers=n_workers, max_ready=_READY_PER_WORKER * n_workers
        )
        self._last_camera: Camera | None = None
        self._requested: list[Piece] = []
        self._memory_factor = 1.0

    def __enter__(self) -> "Scene":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the workers."""
        self._pager.close()

    def exaggerate(self, factor: float) -> None:
        """Change the vertical exaggeration; patches stay as they are."""
        self.frame = self.frame.exaggerated(factor)

    def view(self, camera: Camera, viewport: Viewport, max_pixel_error: float = 1.0) -> View:
        """Return a view of this scene."""
        tau = -1.0 if self.mode == "full" else max_pixel_error
        return View(camera, viewport, tau, self.error, self.frame.exaggeration)

    # One frame

    def update(self, view: View, *, max_uploads: int = _UPLOADS_PER_FRAME) -> Frames:
        """Take what has been built, ask for what is missing, return what to draw. Never waits."""
        started = time.perf_counter()
        if self._last_camera != view.camera:
            self._memory_factor = max(self._memory_factor / _RELIEF, 1.0)
        tau = self._split_error(view)
        wanted = self.table.wanted(view, self.store.max_blocks, tau)
        if self._take(view, wanted, max_uploads):  # what came may have children
            wanted = self.table.wanted(view, self.store.max_blocks, tau)
        missing = self._missing(wanted)
        ahead = [] if missing else self._ahead(view, tau)
        self._request(missing + ahead)
        self._last_camera = view.camera
        paged = time.perf_counter()
        selection, used = self.governor.select(self.table, replace(view, max_pixel_error=tau))
        frames = self._frames(view, selection, used, len(missing))
        self.timings = Timings((paged - started) * 1e3, (time.perf_counter() - paged) * 1e3)
        return frames

    def settle(self, view: View, *, timeout: float = 600.0) -> Frames:
        """Return what to draw once all that the view needs is here; waits for the workers.

        Raises
        ------
        TerrainwaveError
            If it takes longer than `timeout` seconds.
        """
        end = time.monotonic() + timeout
        while True:
            frames = self.update(view, max_uploads=1 << 30)
            if not frames.n_missing:
                return frames
            if not self._pager.wait(max(end - time.monotonic(), 0.0)):
                raise TerrainwaveError(f"the picture is not complete after {timeout:g} seconds")

    def _split_error(self, view: View) -> float:
        """Return the τ below which blocks are split, before the governor."""
        if self.mode == "full":
            return -1.0
        return view.max_pixel_error / MORPH_START * self._memory_factor

    # Paging

    def _missing(self, wanted: NDArray[np.int32]) -> list[Piece]:
        absent = wanted[~self.table.is_resident[wanted]]
        pieces = [self.table.pieces[node] for node in absent.tolist()]
        return [piece for piece in pieces if piece not in self.problems]

    def _ahead(self, view: View, tau: float) -> list[Piece]:
        """Return what the next view will need, if all of this one's is here."""
        if self._last_camera is None or self._last_camera.position == view.camera.position:
            return []
        camera = predict(self._last_camera, view.camera)
        wanted = self.table.wanted(view, self.store.max_blocks, tau, camera)
        return self._missing(wanted)

    def _request(self, pieces: list[Piece]) -> None:
        if pieces != self._requested:
            self._pager.request(pieces)
            self._requested = pieces

    def _take(self, view: View, wanted: NDArray[np.int32], max_uploads: int) -> bool:
        built = self._pager.take(max_uploads)
        if not built:
            return False
        keep = np.zeros(len(self.table), dtype=np.bool_)
        keep[wanted] = True
        self._requested = []  # what could not be kept is asked for again
        for piece, patch, error in built:
            node = self.table.find(piece)
            if error is not None:
                if not isinstance(error, TerrainwaveError):
                    raise error
                self.problems[piece] = str(error)
                if node in self.table.roots:
                    raise error
            elif node is not None and not self.table.is_resident[node]:
                self._keep(view, node, patch, keep)
        return True

    def _keep(self, view: View, node: int, patch: Patch, keep: NDArray[np.bool_]) -> None:
        """Put a patch into the store; what is needed least makes room."""
        table = self.table
        self.table.add_children(node, patch.children)
        if len(keep) < len(table):
            keep = np.pad(keep, (0, len(table) - len(keep)))
        for victim in [None, *table.lowest_priority(view, keep).tolist()]:
            if victim is not None:
                self._drop(victim)
            if self.store.put(node, patch):
                break
        else:
            self._memory_factor *= _PRESSURE  # all that is here is needed: need less
            return
        self._describe(node, patch)

    # Everything, a part at a time

    def finest_in_view(self, view: View) -> list[int]:
        """Return the nodes of all finest pieces in view; reads the index only."""
        table, found = self.table, []
        stack = table.roots.tolist()
        scale = np.array([1.0, 1.0, view.exaggeration])
        planes = view.planes
        while stack:
            node = stack.pop()
            if not may_see(planes, table.low[node] * scale, table.high[node] * scale):
                continue
            if not table.is_known[node]:
                table.add_children(node, self._builder.children(table.pieces[node]))
            children = [child for child in table.children[node].tolist() if child >= 0]
            stack += children
            if not children:
                found.append(node)
        return found

    def parts(self, view: View) -> Iterator[Frames]:
        """Yield all finest pieces in view, as many at a time as the store holds."""
        nodes = self.finest_in_view(view)
        for node in np.flatnonzero(self.table.is_resident[: len(self.table)]).tolist():
            self._drop(node)
        n_done = 0
        while n_done < len(nodes):
            batch: list[int] = []
            for node in nodes[n_done : n_done + self.store.max_blocks]:
                patch = self._builder.build(self.table.pieces[node])
                if not self.store.put(node, patch):
                    break
                self._describe(node, patch)
                batch.append(node)
            if not batch:
                raise LimitExceededError("a block does not fit the memory allowed for pictures")
            selection = Selection(
                np.array(batch, dtype=np.int32),
                np.full(len(batch), _NEAREST_PART),
                int(self.table.n_triangles[batch].sum()),
            )
            yield self._frames(view, selection, 0.0, 0)
            for node in batch:
                self._drop(node)
            n_done += len(batch)

    def _drop(self, node: int) -> None:
        self.store.drop(node)
        self.table.is_resident[node] = False

    def _describe(self, node: int, patch: Patch) -> None:
        """Take down what a patch that is in the store now says of itself."""
        table = self.table
        table.is_resident[node] = True
        table.errors[node] = patch.error
        table.n_triangles[node] = len(patch.triangles)
        self._info.reach(len(table))
        self._info.base[node], self._info.morph[node] = patch.base, patch.morph

    # Drawing

    def _frames(self, view: View, selection: Selection, tau: float, n_missing: int) -> Frames:
        # The nearest first: what they hide need not be shaded.
        order = np.argsort(selection.distances, kind="stable")
        nodes, distances = selection.nodes[order], selection.distances[order]
        n_triangles = selection.n_triangles
        z_scale = view.exaggeration
        errors = self.table.errors[nodes] * z_scale
        # Blocks are split at τ / MORPH_START, so that what is drawn may use up to τ.
        allowed = tau * MORPH_START * distances / view.gamma
        morphs = (
            self._morphs(view, nodes, allowed, tau) if self.mode != "full" else np.zeros(len(nodes))
        )
        drawn = errors + morphs * self._info_of(nodes).morph * z_scale
        # A neighbour's error: within τ at the furthest point that it may share with this block,
        # or one that stands in for others.
        low, high = self.table.low[nodes].copy(), self.table.high[nodes].copy()
        low[:, 2] *= z_scale
        high[:, 2] *= z_scale
        eye = view.camera.eye
        furthest = np.linalg.norm(np.maximum(np.abs(low - eye), np.abs(high - eye)), axis=1)
        beside = tau * MORPH_START * furthest / view.gamma
        too_coarse = drawn[drawn > allowed]
        beside = np.maximum(beside, too_coarse.max(initial=0.0))
        return Frames(
            nodes, distances, morphs, drawn + beside, n_triangles, tau * MORPH_START, n_missing
        )

    def _info_of(self, nodes: NDArray[np.int32]) -> _PatchInfo:
        return _PatchInfo(self._info.base[nodes], self._info.morph[nodes])

    def bases(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return the heights of z = 0 of patches, metres without exaggeration."""
        return self._info.base[nodes]

    def _morphs(
        self, view: View, nodes: NDArray[np.int32], allowed: NDArray[np.float64], tau: float
    ) -> NDArray[np.float64]:
        """Return each block's share of its parent's surface.

        1 where the parent would just be drawn (its error at τ / MORPH_START), 0 where that error
        reaches τ; and no more than leaves error + share · distance to the parent within τ, which
        keeps the promise exactly: between vertices both surfaces are linear.
        """
        z_scale = view.exaggeration
        table = self.table
        parents = table.parents[nodes]
        has_parent = parents >= 0
        above = np.where(has_parent, parents, 0)
        low, high = table.low[above].copy(), table.high[above].copy()
        low[:, 2] *= z_scale
        high[:, 2] *= z_scale
        eye = view.camera.eye
        apart = np.maximum(np.maximum(low - eye, eye - high), 0.0)
        distances = np.maximum(np.linalg.norm(apart, axis=1), 1e-9)
        screen = view.gamma * table.errors[above] * z_scale / distances
        start, end = tau, tau * MORPH_START
        shares = (
            np.clip((end - screen) / (end - start), 0.0, 1.0)
            if end > start
            else np.zeros(len(nodes))
        )
        spread = self._info.morph[nodes] * z_scale
        errors = table.errors[nodes] * z_scale
        budget = np.clip((allowed - errors) / np.maximum(spread, 1e-12), 0.0, 1.0)
        return np.where(has_parent, np.minimum(shares, budget), 0.0)
