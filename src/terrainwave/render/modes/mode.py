"""Interface of a mode.

A mode has three parts, used by `Scene`:

* a tree of pieces (`roots`, `children`) with boxes and errors, from an index: cheap;
* `build`, called in worker threads: returns the data to upload for a piece;
* `gamma`, `split_error`, `wanted` and `frames`, called each frame: select pieces and decide how
  they are drawn.

A surface draws it, which a mode never sees: `render.gpu.surfaces` has the table. A store keeps the
results of `build`, and a program draws them (`render.gpu.surface`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError
from terrainwave.file import TerrainFile
from terrainwave.progress import ProgressCallback
from terrainwave.render.scene.camera import Camera, Viewport, gamma_guaranteed, gamma_paper
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.selection import Built, NodeInfo, NodeTable, Piece, Selection, View

ERRORS = ("measured", "paper")
MAX_TRIANGLES = 20_000_000
# Value of `Frames.tau`, in pixels, from which nothing is guaranteed.
NO_PROMISE = 1e6


class Frames(NamedTuple):
    """Nodes to draw, each with distance, morph and skirt."""

    nodes: NDArray[np.int32]  # shape (n,)
    # shape (n,); from the eye to the nearest part of the box, metres
    distances: NDArray[np.float64]
    morphs: NDArray[np.float64]  # shape (n,); share of the parent's surface, 0 … 1
    skirts: NDArray[np.float64]  # shape (n,); depth of skirts, local metres
    n_triangles: int
    tau: float  # pixels; above the requested one if limits require it
    n_missing: int  # wanted pieces that are not loaded yet


class ModeNeeds(NamedTuple):
    """Arguments of every mode."""

    terrain: TerrainFile
    frame: Frame  # local metres; its exaggeration is not used: the GPU applies it
    # one of the mode's `errors`: guaranteed errors and γ ("measured"), those of its paper
    # ("paper"), or the file's wavelet coefficients ("coefficient")
    error: str = ERRORS[0]
    # called with a `Progress` if the mode needs long preparation
    progress: ProgressCallback | None = None


class Mode(ABC):
    """Way to draw a terrain. Thread-safe only where stated."""

    name: str  # as in ``--mode``
    errors: tuple[str, ...] = ERRORS  # supported errors, as in ``--error``
    # further options, as in `Scene` and on the command line; keywords of its constructor
    options: tuple[str, ...] = ()
    is_partwise = False  # all finest pieces are drawn, as many at a time as the store holds
    # errors count by the direction from which they are seen (`View.is_oriented`)
    is_oriented = False
    # per frame, for modes that make their triangles in `frames`: they raise τ beyond it. Triangles
    # of pieces are counted by the selection.
    max_triangles = MAX_TRIANGLES

    def __init__(self, needs: ModeNeeds) -> None:
        if needs.error not in self.errors:
            raise InvalidArgumentError(
                f"found `error` {needs.error!r} in mode {self.name}, expected one of"
                f" {', '.join(self.errors)}"
            )
        self.terrain, self.frame, self.error, self.progress = needs
        self.n_levels = self.terrain.n_levels  # of its pieces; level 0 is the coarsest

    @classmethod
    def preparation(cls, error: str) -> str | None:  # noqa: ARG003, as some modes need it
        """Return what is decoded before the first picture, and why; None if that is little."""
        return None

    @abstractmethod
    def roots(self) -> list[NodeInfo]:
        """Return the pieces without a parent."""

    @abstractmethod
    def children(self, piece: Piece) -> list[NodeInfo]:
        """Return a piece's children, which replace it all at once; at most four. Thread-safe."""

    @abstractmethod
    def build(self, piece: Piece, is_cancelled: Callable[[], bool] = lambda: False) -> Built:
        """Build the drawable form of a piece. Thread-safe.

        Raises `Cancelled` if `is_cancelled` returns True between two steps, `CorruptStreamError` if
        the file is damaged there.
        """

    # In the drawing thread, when pieces are loaded and dropped

    def keep(self, piece: Piece, built: Built) -> None:  # noqa: B027  most modes need not know
        """Record the result of building a piece that is now in the store."""

    def drop(self, piece: Piece) -> None:  # noqa: B027
        """Remove a piece that has left the store."""

    def gamma(self, camera: Camera, viewport: Viewport) -> float:
        """Return γ of ``error on screen = γ · error / distance``."""
        formula = gamma_paper if self.error == "paper" else gamma_guaranteed
        return formula(camera, viewport)

    @property
    def is_bound(self) -> bool:
        """Return whether pictures are guaranteed to be within `Frames.tau` of the terrain."""
        return self.error == "measured"

    @property
    def has_limit(self) -> bool:
        """Return whether pieces are selected so that pictures are within the requested τ."""
        return self.is_bound

    @property
    def is_exact(self) -> bool:
        """Return whether errors count by each piece's position in the picture (`View`)."""
        return self.error == "measured"

    def split_error(self, tau: float) -> float:
        """Return the error on screen above which pieces are split, for the requested τ."""
        return tau

    def wanted(
        self, table: NodeTable, view: View, tau: float, max_blocks: int, camera: Camera
    ) -> NDArray[np.int32]:
        """Return the nodes to have in memory for a camera, the most urgent first."""
        return table.wanted(view, max_blocks, tau, camera)

    def spare(self, table: NodeTable, view: View, max_blocks: int) -> NDArray[np.int32]:  # noqa: ARG002
        """Return further pieces to load once all wanted ones are here."""
        return np.empty(0, dtype=np.int32)

    @abstractmethod
    def frames(
        self, table: NodeTable, view: View, selection: Selection, tau: float, n_missing: int
    ) -> Frames:
        """Return how to draw a selection that was split at `tau`, from `split_error`."""
