"""One terrain as seen by moving cameras: what is here, what is wanted, what to draw. No GPU."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import LimitExceededError, TerrainwaveError
from terrainwave.progress import ProgressCallback
from terrainwave.render.camera import Camera, Viewport, predict
from terrainwave.render.frame import Frame, frame_of
from terrainwave.render.frustum import may_see
from terrainwave.render.modes import mode_class, options_of
from terrainwave.render.modes.mode import MAX_TRIANGLES, Frames, Mode
from terrainwave.render.paging import Pager
from terrainwave.render.selection import Built, ErrorGovernor, NodeTable, Piece, Selection, View

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

DEFAULT_MAX_BYTES = 512 << 20
_UPLOADS_PER_FRAME = 4
_READY_PER_WORKER = 4
# Depth planes where all is drawn in parts: one for all of them.
_NEAREST_PART = 0.0
# Where what is needed does not fit, τ is raised by steps; it sinks again as the camera moves on.
_PRESSURE, _RELIEF = 1.1, 1.02


class Store(Protocol):
    """Where what `Mode.build` returns is kept to be drawn: the GPU, or a list in tests."""

    @property
    def max_blocks(self) -> int:
        """Return how many pieces fit."""

    def put(self, node: int, built: Any) -> bool:
        """Keep what was built; false if there is no room."""

    def drop(self, node: int) -> None:
        """Forget it."""

    @property
    def n_bytes(self) -> int:
        """Return the bytes of what is kept."""


@dataclass
class Timings:
    """CPU milliseconds of the last update by part."""

    page: float = 0.0
    select: float = 0.0


class Scene:
    """A terrain with a store of patches.

    Parameters
    ----------
    terrain : TerrainFile
    store : Store
    mode : str
        One of `terrainwave.render.modes.MODES`.
    error : str
        One of the mode's `errors`.
    detail : float, optional
        μ > 0 of mode batched with error "paper": a level's error is μ times its spacing; 0.5 by
        default.
    order : int, optional
        Of Neville's filter, 2 or 4 (default), that makes the levels of mode batched.
    stepwise : bool
        Modes dynamic and vertex-texture change by one height of their quadtree a frame, as their
        paper does: what they keep is `Frames.tau`, more than τ while they lag behind the view.
    orientation : bool
        In modes adaptive, batched and loose with measured errors, these count less the steeper they
        are looked down at; τ holds all the same.
    exaggeration, radius : float, optional
        See `frame_of`.
    max_triangles : int
        Per frame; τ is raised beyond it.
    target_ms : float, optional
        Per frame; τ is raised where it takes longer.
    n_workers : int
        Threads that read, decode and build.
    progress : callable, optional
        Called with a `Progress` where a mode prepares for long.

    Notes
    -----
    Used by one thread, but for the workers. A context manager.
    """

    def __init__(
        self,
        terrain: "TerrainFile",
        store: Store,
        *,
        mode: str = "adaptive",
        error: str = "measured",
        detail: float | None = None,
        order: int | None = None,
        stepwise: bool = False,
        orientation: bool = False,
        exaggeration: float = 1.0,
        radius: float | None = None,
        max_triangles: int = MAX_TRIANGLES,
        target_ms: float | None = None,
        n_workers: int = 2,
        progress: ProgressCallback | None = None,
    ) -> None:
        self.terrain = terrain
        self.frame: Frame = frame_of(terrain, radius=radius, exaggeration=exaggeration)
        given = options_of(
            mode, detail=detail, order=order, stepwise=stepwise, orientation=orientation
        )
        self.mode: Mode = mode_class(mode)(
            terrain, self.frame, error=error, progress=progress, **given
        )
        self.store = store
        self.table = NodeTable()
        self.mode.max_triangles = max_triangles
        self.governor = ErrorGovernor(max_triangles, target_ms)
        self.timings = Timings()
        self.problems: dict[Piece, str] = {}
        for info in self.mode.roots():
            self.table.add(info)
        self._pager = Pager(
            self.mode.build, n_workers=n_workers, max_ready=_READY_PER_WORKER * n_workers
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
        self.mode.close()

    def exaggerate(self, factor: float) -> None:
        """Change the vertical exaggeration; patches stay as they are."""
        self.frame = self.frame.exaggerated(factor)

    def view(self, camera: Camera, viewport: Viewport, max_pixel_error: float = 1.0) -> View:
        """Return a view of this scene, in more detail where the terrain is flat."""
        max_pixel_error *= self.frame.detail
        mode, exaggeration = self.mode, self.frame.exaggeration
        return View(
            camera, viewport, max_pixel_error, mode.gamma, exaggeration, mode.is_oriented
        )  # fmt: skip

    # One frame

    def update(self, view: View, *, max_uploads: int = _UPLOADS_PER_FRAME) -> Frames:
        """Take what has been built, ask for what is missing, return what to draw. Never waits."""
        started = time.perf_counter()
        if self._last_camera != view.camera:
            self._memory_factor = max(self._memory_factor / _RELIEF, 1.0)
        tau = self._split_error(view)
        wanted = self._wanted(view, tau)
        spare = self._spare(view, wanted)
        if self._take(view, np.concatenate([wanted, spare]), max_uploads):
            wanted = self._wanted(view, tau)  # what came may have children
            spare = self._spare(view, wanted)
        missing = self._missing(wanted)
        ahead = [] if missing else (self._missing(spare) or self._ahead(view, tau))
        self._request(missing + ahead)
        self._last_camera = view.camera
        paged = time.perf_counter()
        selection, used = self.governor.select(self.table, replace(view, max_pixel_error=tau))
        frames = self.mode.frames(self.table, view, selection, used, len(missing))
        self.timings = Timings((paged - started) * 1e3, (time.perf_counter() - paged) * 1e3)
        return frames

    def settle(self, view: View, *, timeout: float = 600.0) -> Frames:
        """Return the settled frame: all that the view needs is here; waits for the workers.

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
        return self.mode.split_error(view.max_pixel_error) * self._memory_factor

    # Paging

    def _wanted(self, view: View, tau: float, camera: Camera | None = None) -> NDArray[np.int32]:
        camera = camera or view.camera
        return self.mode.wanted(self.table, view, tau, self.store.max_blocks, camera)

    def _spare(self, view: View, wanted: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the pieces to have besides `wanted`, as many as there is room for."""
        spare = self.mode.spare(self.table, view, self.store.max_blocks)
        spare = spare[~np.isin(spare, wanted)]
        return spare[: self.store.max_blocks - len(wanted)]

    def _missing(self, wanted: NDArray[np.int32]) -> list[Piece]:
        absent = wanted[~self.table.is_resident[wanted]]
        pieces = [self.table.pieces[node] for node in absent.tolist()]
        return [piece for piece in pieces if piece not in self.problems]

    def _ahead(self, view: View, tau: float) -> list[Piece]:
        """Return the pieces the next view will need, if all of this one's are here."""
        if self._last_camera is None or self._last_camera.position == view.camera.position:
            return []
        camera = predict(self._last_camera, view.camera)
        return self._missing(self._wanted(view, tau, camera))

    def _request(self, pieces: list[Piece]) -> None:
        if pieces != self._requested:
            self._pager.request(pieces)
            self._requested = pieces

    def _take(self, view: View, wanted: NDArray[np.int32], max_uploads: int) -> bool:
        taken = self._pager.take(max_uploads)
        if not taken:
            return False
        keep = np.zeros(len(self.table), dtype=np.bool_)
        keep[wanted] = True
        self._requested = []  # what could not be kept is asked for again
        for piece, built, error in taken:
            node = self.table.find(piece)
            if error is not None:
                if not isinstance(error, TerrainwaveError):
                    raise error
                self.problems[piece] = str(error)
                if node in self.table.roots:
                    raise error
            elif node is not None and not self.table.is_resident[node]:
                self._keep(view, node, built, keep)
        return True

    def _keep(self, view: View, node: int, built: Built, keep: NDArray[np.bool_]) -> None:
        """Put what was built into the store; what is needed least makes room."""
        table = self.table
        table.add_children(node, built.children)
        if len(keep) < len(table):
            keep = np.pad(keep, (0, len(table) - len(keep)))
        for victim in [None, *table.lowest_priority(view, keep).tolist()]:
            if victim is not None:
                self._drop(victim)
            if self.store.put(node, built):
                break
        else:
            self._memory_factor *= _PRESSURE  # all that is here is needed: need less
            return
        table.describe(node, built)
        self.mode.keep(table.pieces[node], built)

    # Everything, a part at a time

    def finest_in_view(self, view: View) -> list[int]:
        """Return the nodes of all finest pieces in view; reads the index only."""
        table, nodes = self.table, []
        stack = table.roots.tolist()
        scale = np.array([1.0, 1.0, view.exaggeration])
        planes = view.planes
        while stack:
            node = stack.pop()
            if not may_see(planes, table.low[node] * scale, table.high[node] * scale):
                continue
            if not table.is_known[node]:
                table.add_children(node, self.mode.children(table.pieces[node]))
            children = [child for child in table.children[node].tolist() if child >= 0]
            stack += children
            if not children:
                nodes.append(node)
        return nodes

    def parts(self, view: View) -> Iterator[Frames]:
        """Yield all finest pieces in view, as many at a time as the store holds."""
        nodes = self.finest_in_view(view)
        for node in np.flatnonzero(self.table.is_resident[: len(self.table)]).tolist():
            self._drop(node)
        n_done = 0
        while n_done < len(nodes):
            batch: list[int] = []
            for node in nodes[n_done : n_done + self.store.max_blocks]:
                built = self.mode.build(self.table.pieces[node])
                if not self.store.put(node, built):
                    break
                self.table.describe(node, built)
                self.mode.keep(self.table.pieces[node], built)
                batch.append(node)
            if not batch:
                raise LimitExceededError("a block does not fit the memory allowed for pictures")
            selection = Selection(
                np.array(batch, dtype=np.int32),
                np.full(len(batch), _NEAREST_PART),
                int(self.table.n_triangles[batch].sum()),
            )
            yield self.mode.frames(self.table, view, selection, 0.0, 0)
            for node in batch:
                self._drop(node)
            n_done += len(batch)

    def _drop(self, node: int) -> None:
        self.store.drop(node)
        self.mode.drop(self.table.pieces[node])
        self.table.is_resident[node] = False
