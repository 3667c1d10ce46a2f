"""One terrain under moving cameras: patches that are loaded, wanted and drawn."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import LimitExceededError, TerrainwaveError
from terrainwave.file import TerrainFile
from terrainwave.progress import ProgressCallback
from terrainwave.render.modes import mode_class
from terrainwave.render.modes.drawn_options import DrawnOptions
from terrainwave.render.modes.mode import MAX_TRIANGLES, NO_PROMISE, Frames, Mode, ModeNeeds
from terrainwave.render.paging.motion import Motion
from terrainwave.render.paging.pager import Arrival, Pager
from terrainwave.render.paging.problems import Problems, replies_of
from terrainwave.render.paging.read_ahead import PATIENCE, read_ahead_of
from terrainwave.render.scene.camera import Camera, Viewport, focal_length, slant
from terrainwave.render.scene.frame import Frame, frame_of
from terrainwave.render.scene.frustum import may_see
from terrainwave.render.scene.horizon import Horizon
from terrainwave.render.scene.selection import (
    Built,
    ErrorGovernor,
    NodeTable,
    Piece,
    Selection,
    View,
)

# Pieces that one frame takes, and seconds of processor time.
_UPLOADS_PER_FRAME, _UPLOAD_S = 6, 0.0005
_READY_PER_WORKER = 4
# Where what is needed does not fit, τ is raised by steps; it sinks again as the camera moves on.
_PRESSURE, _RELIEF = 1.1, 1.02
# How much a piece is needed: not, soon, now.
_NOT, _AHEAD, _WANTED = range(3)
# What will be needed is looked at every so many frames, one more than `AHEAD` has.
_FRAMES_PER_LOOK = 5
# Of the pieces that fit, at most this share are coarse ones all around.
_COARSE_SHARE = 32
# Pieces that are asked for at a time.
_MOST_ASKED = 64
# Pieces that are known before those that nobody needs are forgotten, at about half a kilobyte each.
_MOST_KNOWN = 8192
_NO_REACH = 1e30
# Pixels: a GPU moves vertices to a grid of this spacing, and its float32 loses less.
_GPU_GRID = 1 / 256
_NO_ROOM = "a block does not fit the memory allowed for pictures"


class PieceStore(Protocol):
    """Store of what `Mode.build` returns, for drawing: the GPU, or a list in tests."""

    @property
    def max_blocks(self) -> int: ...
    def put(self, node: int, built: Any) -> bool: ...  # false if there is no room
    def drop(self, node: int) -> None: ...
    @property
    def n_bytes(self) -> int: ...


@dataclass
class Timings:
    """CPU milliseconds of the last update by part."""

    page: float = 0.0
    select: float = 0.0


@dataclass(frozen=True, kw_only=True)
class SceneOptions(DrawnOptions):
    """Options of a `Scene`."""

    max_triangles: int = MAX_TRIANGLES  # per frame; τ is raised beyond it
    target_ms: float | None = None  # per frame; τ is raised where it takes longer
    # blocks behind nearer ground are neither drawn nor asked for, in modes adaptive, batched and
    # loose with measured errors, while the eye is above the ground
    horizon: bool = True
    n_workers: int = 2  # threads that read, decode and build
    # ask again for what a server did not send, after pauses, and the roots too; by default what
    # cannot be read is drawn coarser, and a root raises
    retries: bool = False
    # called with a `Progress` where a mode prepares for long
    progress: ProgressCallback | None = None


class Scene:
    """A terrain with a store of patches. Used by one thread, but for the workers.

    `options` are those of `SceneOptions`.
    """

    def __init__(self, terrain: TerrainFile, store: PieceStore, **options: Any) -> None:
        asked = SceneOptions(**options)
        self.terrain = terrain
        self.frame: Frame = frame_of(terrain, radius=asked.radius, exaggeration=asked.exaggeration)
        self.n_workers = n_workers = asked.n_workers
        self.options = given = asked.of_mode()
        needs = ModeNeeds(terrain, self.frame, asked.error, asked.progress)
        self.mode: Mode = mode_class(asked.mode)(needs, **given)
        self.store = store
        self.table = NodeTable()
        self.mode.max_triangles = asked.max_triangles
        self.governor = ErrorGovernor(asked.max_triangles, asked.target_ms)
        self.timings = Timings()
        self.problems = Problems(retries=asked.retries, n_replies=replies_of(terrain))
        for info in self.mode.roots():
            self.table.add(info)
        self._pager = Pager(
            self.mode.build, n_workers=n_workers, max_ready=_READY_PER_WORKER * n_workers
        )
        self._ahead_reader = read_ahead_of(terrain, self.mode)
        self._motion = Motion()
        self._n_updates = 0
        self._cameras: list[Camera] = []
        self._looks: dict[int, NDArray[np.int32]] = {}
        self._needed = self._soon = np.empty(0, dtype=np.int32)
        self._last_camera: Camera | None = None
        self._requested: list[int] = []
        # Whether pieces behind others are left out; pictures that are seen through need them all.
        self.has_horizon = asked.horizon
        self._shown, self._tau = np.empty(0, dtype=np.int32), 0.0  # nodes of the last frame
        self._memory_factor, self._is_short = 1.0, True
        self._most_known = _MOST_KNOWN

    def __enter__(self) -> "Scene":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        # A server that is silent would hold them for long.
        self._pager.close(None if replies_of(self.terrain) is None else PATIENCE)
        if self._ahead_reader is not None:
            self._ahead_reader.close()

    def exaggerate(self, factor: float) -> None:
        self.frame = self.frame.exaggerated(factor)

    def view(self, camera: Camera, viewport: Viewport, max_pixel_error: float = 1.0) -> View:
        """Return a view of this scene, in more detail where the terrain is flat.

        But not in more than a sample for each pixel, which light and colours do not show.
        """
        detail = self.frame.detail(camera.eye)
        return View(
            camera, viewport, max_pixel_error * detail, self.mode.gamma, self.frame.exaggeration,
            self.mode.is_oriented, self.mode.is_exact, 1.0 / detail,
        )  # fmt: skip

    @property
    def wanted(self) -> NDArray[np.int32]:
        """Return the nodes that the last frame needed, with those above them; for reading."""
        return self._needed

    @property
    def build_ms(self) -> list[float]:
        """Return what the last pieces took to read, decode and build: CPU milliseconds."""
        return list(self._pager.build_ms)

    @property
    def n_cancelled(self) -> int:
        return self._pager.n_cancelled

    def update(self, view: View, *, max_uploads: int = _UPLOADS_PER_FRAME) -> Frames:
        """Take what has been built, ask for what is missing, return what to draw. Never waits."""
        started = time.perf_counter()
        self._motion.see(view.camera)
        if self._last_camera != view.camera and not self._is_short:
            self._memory_factor = max(self._memory_factor / _RELIEF, 1.0)
        tau = self._split_error(view)
        self._forget()
        self._take(view, max_uploads)
        view = replace(view, horizon=self._horizon(view, view.camera))
        wanted = self._needed = self._wanted(view, tau)
        ahead = self._soon = self._ahead(view, tau, wanted)
        missing = self._missing(wanted)
        self._is_short = len(missing) > 0
        asked = [missing, self._missing(ahead)]
        if self._is_short:  # what leaves τ first, then what is to be split a little before it is
            most = view.max_pixel_error * self._memory_factor
            # Both are cut to what fits, by different orders: what is not wanted is never kept.
            urgent = np.intersect1d(self._wanted(view, most), missing)
            asked.insert(0, self._by_error(view, urgent))
        self._request(np.concatenate(asked))
        if self._is_short and self._ahead_reader is not None:
            self._ahead_reader.look(view, tau, self._is_here)
        self._last_camera = view.camera
        paged = time.perf_counter()
        selection, used = self.governor.select(self.table, view, tau)
        if self.table.stand_in(view, selection.nodes, used, self._shown):
            # What made the horizon is not all drawn.
            view = replace(view, horizon=Horizon.none())
            selection, used = self.governor.select(self.table, view, tau)
        n_missing = len(missing) + self.problems.n_held
        frames = self.mode.frames(self.table, view, selection, used, n_missing)
        self._shown = frames.nodes
        # What is drawn in the place of another piece is no further from it, but for loose meshes.
        self._tau = frames.tau if self.mode.has_limit else 2 * used
        self.timings = Timings((paged - started) * 1e3, (time.perf_counter() - paged) * 1e3)
        return frames

    def settle(self, view: View, *, timeout: float = 600.0) -> Frames:
        """Return the settled frame: all that the view needs is here; waits for the workers."""
        end, n_more = time.monotonic() + timeout, 1 if self.mode.has_limit else 2
        while True:
            frames = self.update(view, max_uploads=1 << 30)
            if not frames.n_missing:
                # What loose meshes that came last do not hide is seen in the next frame.
                n_more -= 1
                if not n_more:
                    return frames
                continue
            if not self._pager.wait(max(end - time.monotonic(), 0.0)):
                raise TerrainwaveError(f"the picture is not complete after {timeout:g} seconds")

    def kept_error(self, view: View, frames: Frames) -> float:
        """Return what a settled frame is within, pixels: τ, or the errors of its finest pieces.

        Never less than the grid on which a GPU draws. Infinite where nothing is promised, and where
        the eye is in the box of a piece.
        """
        if not self.mode.is_bound:
            return math.inf
        finest = float(self.table.on_screen(view, frames.nodes).max(initial=0.0))
        kept = max(frames.tau, finest, _GPU_GRID)
        return kept if kept < NO_PROMISE else math.inf

    def skirt_reach(self, view: View, frames: Frames) -> float:
        """Return how deep skirts need be, per metre of distance where they are seen from the side.

        A surface and its neighbour's are both within `kept_error`. A vertical metre at a distance
        d, h of it level, is f h / d² pixels at least, and counts as that over the slant of the
        picture's corners at least. Much where nothing says how deep they need be.
        """
        kept = self.kept_error(view, frames)
        if not math.isfinite(kept):
            return _NO_REACH
        length = focal_length(view.camera, view.viewport)
        return 2 * kept * slant(view.camera, view.viewport) / length

    def drawn_error(self, view: View, frames: Frames) -> float:
        """Return the largest error on screen, pixels, of what is drawn and could be finer.

        0 where all of it is the finest that the file has, at most the picture's diagonal. Above τ
        only while finer pieces are on their way, or do not fit.
        """
        table, nodes = self.table, frames.nodes
        is_finest = table.is_known[nodes] & (table.children[nodes] < 0).all(axis=1)
        errors = table.errors[nodes] + frames.morphs * table.morphs[nodes]
        on_screen = table.on_screen(view, nodes, errors)
        diagonal = math.hypot(view.viewport.width, view.viewport.height)
        return min(float(on_screen[~is_finest].max(initial=0.0)), diagonal)

    def _horizon(self, view: View, camera: Camera) -> Horizon:
        """Return what the pieces of the last frame hide from a camera.

        Others may be drawn in their place: within τ all the same, or `NodeTable.stand_in` says so.
        In modes without a limit, others may be further away, for a frame.
        """
        if not (self.has_horizon and self.mode.is_bound):
            return Horizon.none()
        eye, ground = camera.eye, self.table.floor_at(*camera.position[:2])
        if ground == -np.inf or eye[2] < ground * view.exaggeration:
            return Horizon.none()  # from below, and from beside, ground is seen through
        low, high = self.frame.box
        reach = float(np.linalg.norm(np.maximum(np.abs(low - eye), np.abs(high - eye))))
        tau = max(view.max_pixel_error * view.flatness, self._tau)
        return Horizon.of(
            camera, view.viewport, self.table.floors(self._shown),
            exaggeration=view.exaggeration, reach=reach, margin=tau / view.least_gamma,
        )  # fmt: skip

    def _split_error(self, view: View) -> float:
        return self.mode.split_error(view.max_pixel_error) * self._memory_factor

    def _forget(self) -> None:
        """Forget pieces far from where the camera is, once many are known."""
        if self.table.n_known > self._most_known:
            self.table.forget_children(
                [self._needed, self._soon, self._shown, *self._looks.values()]
            )
            self._most_known = max(_MOST_KNOWN, 2 * self.table.n_known)

    def _wanted(self, view: View, tau: float, camera: Camera | None = None) -> NDArray[np.int32]:
        if camera is None:
            camera = view.camera
        else:
            view = replace(view, camera=camera, horizon=self._horizon(view, camera))
        return self.mode.wanted(self.table, view, tau, self.store.max_blocks, camera)

    def _ahead(self, view: View, tau: float, wanted: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the pieces to have besides `wanted`, as many as there is room for.

        Those of coarse levels all around, which stand in where the camera turns to; what it will
        see if it goes on as it does, soonest first; then the mode's own. One of these is looked at
        each frame.
        """
        turn = self._n_updates % _FRAMES_PER_LOOK
        self._n_updates += 1
        if turn == 0:
            self._cameras = self._motion.ahead()
            n_looks = len(self._cameras) + 1
            self._looks = {k: nodes for k, nodes in self._looks.items() if k < n_looks}
            self._looks[0] = self.table.coarse_nodes(self.store.max_blocks // _COARSE_SHARE)
            self._looks[_FRAMES_PER_LOOK] = self.mode.spare(self.table, view, self.store.max_blocks)
        elif turn <= len(self._cameras) and not self._is_short:
            self._looks[turn] = self._wanted(view, tau, self._cameras[turn - 1])
        looked = np.concatenate([nodes for _, nodes in sorted(self._looks.items())])
        is_wanted = np.zeros(len(self.table), dtype=np.bool_)
        is_wanted[wanted] = True
        ahead = looked[~is_wanted[looked]]
        return ahead[: max(self.store.max_blocks - len(wanted), 0)]

    def _missing(self, wanted: NDArray[np.int32]) -> NDArray[np.int32]:
        absent = wanted[~self.table.is_resident[wanted]]
        if self.problems.is_clear:
            return absent
        holds, pieces = self.problems.holds, self.table.pieces
        return np.array([n for n in absent.tolist() if not holds(pieces[n])], dtype=np.int32)

    def _is_here(self, piece: Piece) -> bool:
        node = self.table.find(piece)
        return node is not None and bool(self.table.is_resident[node])

    def _by_error(self, view: View, nodes: NDArray[np.int32]) -> NDArray[np.int32]:
        table = self.table
        parents = table.parents[nodes]
        above = np.maximum(parents, 0)
        errors = np.where(parents < 0, np.inf, table.on_screen(view, above))
        return nodes[np.argsort(-errors, kind="stable")]

    def _request(self, nodes: NDArray[np.int32]) -> None:
        """Ask for the first of some nodes; the others' turn comes in later frames."""
        first = list(dict.fromkeys(nodes[: 2 * _MOST_ASKED].tolist()))[:_MOST_ASKED]
        if first != self._requested:
            pieces = [self.table.pieces[node] for node in first]
            self._pager.request(pieces)
            if self._ahead_reader is not None:
                self._ahead_reader.request(pieces)
            self._requested = first

    def _take(self, view: View, max_uploads: int) -> None:
        """Put what has been built into the store, where the last frame needs it.

        At most `max_uploads`, and for no longer than `_UPLOAD_S` where that is more than one: the
        rest comes next frame.
        """
        needs, started = None, time.thread_time()
        for number in range(max_uploads):
            is_late = number and time.thread_time() - started > _UPLOAD_S
            taken = [] if is_late and max_uploads <= _UPLOADS_PER_FRAME else self._pager.take(1)
            if not taken:
                break
            if needs is None:
                needs = np.zeros(len(self.table), dtype=np.int8)
                needs[self._soon], needs[self._needed] = _AHEAD, _WANTED
                self._requested = []  # what could not be kept is asked for again
            self._take_in(view, taken[0], needs)

    def _take_in(self, view: View, outcome: Arrival, needs: NDArray[np.int8]) -> None:
        piece, built, error = outcome
        node = self.table.find(piece)
        if error is None:
            self.problems.came()
            if node is not None and not self.table.is_resident[node]:
                self._keep(view, node, built, needs)
            return
        if not isinstance(error, TerrainwaveError):
            raise error
        self.problems.add(piece, error)
        if node in self.table.roots and piece in self.problems.damaged:
            raise error

    def _keep(self, view: View, node: int, built: Built, needs: NDArray[np.int8]) -> None:
        """Put what was built into the store; what is needed least, and less than it, makes room."""
        table = self.table
        table.add_children(node, built.children)
        need = int(needs[node]) if node < len(needs) else _NOT
        if not self.store.put(node, built) and not self._make_room(view, node, built, needs, need):
            if not table.is_resident.any():
                raise LimitExceededError(_NO_ROOM)
            if need == _WANTED:
                self._memory_factor *= _PRESSURE  # all that is here is needed: need less
            return
        table.describe(node, built)
        self.mode.keep(table.pieces[node], built)

    def _make_room(
        self, view: View, node: int, built: Built, needs: NDArray[np.int8], need: int
    ) -> bool:
        table = self.table
        needs = np.pad(needs, (0, len(table) - len(needs)))
        for threshold in range(_AHEAD, need + 1):
            for victim in table.lowest_priority(view, needs >= threshold).tolist():
                self._drop(victim)
                if self.store.put(node, built):
                    return True
        return False

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
        # One for all parts: they share their depths.
        nearest = self.table.distances(view, np.array(nodes, dtype=np.int32)).min(initial=np.inf)
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
                raise LimitExceededError(_NO_ROOM)
            selection = Selection(
                np.array(batch, dtype=np.int32),
                np.full(len(batch), nearest),
                int(self.table.n_triangles[batch].sum()),
            )
            yield self.mode.frames(self.table, view, selection, 0.0, 0)
            for node in batch:
                self._drop(node)
            n_done += len(batch)

    def _drop(self, node: int) -> None:
        self.store.drop(node)
        self.mode.drop(self.table.pieces[node])
        self.table.forget(node)
