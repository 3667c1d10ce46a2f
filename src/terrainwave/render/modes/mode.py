"""The interface of a mode.

A mode has three parts, and `Scene` knows no more of it:

* a tree of pieces (`roots`, `children`) with boxes and errors, from an index: cheap;
* `build`, called in worker threads: what is uploaded for a piece;
* `gamma`, `split_error`, `wanted` and `frames`, called each frame: which pieces are wanted and how
  they are drawn.

What draws it, a surface, is the other half, which a mode never sees: `render.gpu.surfaces` has the
table. A store keeps what `build` returned, and a program draws it (`render.gpu.surface`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError
from terrainwave.progress import ProgressCallback
from terrainwave.render.scene.camera import Camera, Viewport, gamma_guaranteed, gamma_paper
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.selection import Built, NodeInfo, NodeTable, Piece, Selection, View

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

ERRORS = ("measured", "paper")
MAX_TRIANGLES = 20_000_000
# What `Frames.tau` is where nothing is promised, pixels, or more.
NO_PROMISE = 1e6


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
        Wanted pieces that are not here yet.
    """

    nodes: NDArray[np.int32]
    distances: NDArray[np.float64]
    morphs: NDArray[np.float64]
    skirts: NDArray[np.float64]
    n_triangles: int
    tau: float
    n_missing: int


class ModeNeeds(NamedTuple):
    """What every mode needs.

    Parameters
    ----------
    terrain : TerrainFile
    frame : Frame
        Local metres; its exaggeration is not used: the GPU applies it.
    error : str
        One of the mode's `errors`: errors and γ that hold everywhere ("measured"), those of its
        paper ("paper"), or the file's wavelet coefficients ("coefficient").
    progress : callable, optional
        Called with a `Progress` where the mode prepares for long.
    """

    terrain: "TerrainFile"
    frame: Frame
    error: str = ERRORS[0]
    progress: ProgressCallback | None = None


class Mode(ABC):
    """A way to draw a terrain. Thread-safe where it says so.

    Attributes
    ----------
    name : str
        As in ``--mode``.
    errors : tuple of str
        That it knows, as in ``--error``.
    options : tuple of str
        What it can be told besides, as `Scene` and the command line have it; the same keywords of
        its constructor.
    is_partwise : bool
        All finest pieces are drawn, as many at a time as the store holds.
    n_levels : int
        Of its pieces; level 0 is the coarsest.
    is_oriented : bool
        Errors count by the direction they are seen from (`View.is_oriented`).
    max_triangles : int
        Per frame, for modes that make their triangles in `frames`: they raise τ beyond it. Those
        of pieces are counted by who selects them.
    """

    name: str
    errors: tuple[str, ...] = ERRORS
    options: tuple[str, ...] = ()
    is_partwise = False
    is_oriented = False
    max_triangles = MAX_TRIANGLES

    def __init__(self, needs: ModeNeeds) -> None:
        if needs.error not in self.errors:
            raise InvalidArgumentError(
                f"found `error` {needs.error!r} in mode {self.name}, expected one of"
                f" {', '.join(self.errors)}"
            )
        self.terrain, self.frame, self.error, self.progress = needs
        self.n_levels = self.terrain.n_levels

    @classmethod
    def preparation(cls, error: str) -> str | None:  # noqa: ARG003, as some modes need it
        """Say what is decoded before the first picture, and what for; None if that is little."""
        return None

    def close(self) -> None:  # noqa: B027  most modes have nothing to close
        """Free what it holds; no `build` runs any more."""

    # The tree: what the index says

    @abstractmethod
    def roots(self) -> list[NodeInfo]:
        """Return the pieces without a parent."""

    @abstractmethod
    def children(self, piece: Piece) -> list[NodeInfo]:
        """Return a piece's children, which replace it all at once; at most four. Thread-safe."""

    # In worker threads

    @abstractmethod
    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> Built:
        """Build what is drawn for a piece. Thread-safe.

        Raises
        ------
        Cancelled
            If `is_cancelled` says so between two steps.
        CorruptStreamError
            If the file is damaged there.
        """

    # In the thread that draws, as pieces come and go

    def keep(self, piece: Piece, built: Built) -> None:  # noqa: B027  most modes need not know
        """Take what was built for a piece that has come to the store."""

    def drop(self, piece: Piece) -> None:  # noqa: B027
        """Forget a piece that has left the store."""

    # Each frame

    def gamma(self, camera: Camera, viewport: Viewport) -> float:
        """Return γ of ``error on screen = γ · error / distance``."""
        formula = gamma_paper if self.error == "paper" else gamma_guaranteed
        return formula(camera, viewport)

    @property
    def is_bound(self) -> bool:
        """Say whether pictures are within `Frames.tau` pixels of the terrain for certain."""
        return self.error == "measured"

    @property
    def has_limit(self) -> bool:
        """Say whether pieces are chosen so that pictures are within the τ that was asked for."""
        return self.is_bound

    @property
    def is_exact(self) -> bool:
        """Say whether errors count as each piece's place in the picture has it (`View`)."""
        return self.error == "measured"

    def split_error(self, tau: float) -> float:
        """Return the error on screen above which pieces are split, for τ asked for."""
        return tau

    def wanted(
        self, table: NodeTable, view: View, tau: float, max_blocks: int, camera: Camera
    ) -> NDArray[np.int32]:
        """Return the nodes to have in memory for a camera, the most urgent first."""
        return table.wanted(view, max_blocks, tau, camera)

    def spare(
        self,
        table: NodeTable,  # noqa: ARG002, as modes that read ahead need all three
        view: View,  # noqa: ARG002
        max_blocks: int,  # noqa: ARG002
    ) -> NDArray[np.int32]:
        """Return the pieces to have besides, once all that is wanted is here."""
        return np.empty(0, dtype=np.int32)

    @abstractmethod
    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        """Return how to draw a selection that was split at `tau`, from `split_error`."""
