"""Unreadable parts of a damaged file."""

import threading
from dataclasses import dataclass
from typing import Any, NamedTuple

from terrainwave.errors import CorruptStreamError
from terrainwave.forks import renew_after_fork
from terrainwave.grid.quadtree import Block, Grid


class Lost(NamedTuple):
    """A unit that is damaged, or lies below a damaged one: its level, window and problem.

    The window is ``(first_row, first_col, n_rows, n_cols)``, in samples of the level.
    """

    level: int
    window: tuple[int, int, int, int]
    problem: str

    def __str__(self) -> str:
        row, col, n_rows, n_cols = self.window
        return (
            f"level {self.level}, rows {row} to {row + n_rows - 1}, columns {col} to"
            f" {col + n_cols - 1}: {self.problem}"
        )


@dataclass(frozen=True)
class Losses:
    """Damage of a file that was read anyway.

    Attributes
    ----------
    share : float
        Share of the window's samples in damaged parts, 0 … 1. Samples on the border to an intact
        part are not lost.
    missing_bytes : int
        Bytes missing at the end of the file.
    parts : tuple of Lost
        Damaged units, coarse levels first.
    """

    share: float
    missing_bytes: int
    parts: tuple[Lost, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as values for JSON."""
        return {
            "share": self.share,
            "missing_bytes": self.missing_bytes,
            "parts": [part._asdict() for part in self.parts],
        }


class LostUnits:
    """Collects lost units, each once; from any number of threads."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._problems: dict[Block, str] = {}
        self._lock = threading.Lock()
        renew_after_fork(self)

    def renew(self) -> None:
        """Reset after a fork."""
        self._lock = threading.Lock()

    def note(self, key: Block, error: CorruptStreamError) -> None:
        """Record that a unit cannot be read."""
        with self._lock:
            self._problems.setdefault(key, str(error))

    def list(self) -> list[Lost]:
        """Return the lost units, coarse levels first."""
        with self._lock:
            found = sorted(self._problems.items())
        return [self._lost(key, problem) for key, problem in found]

    def _lost(self, key: Block, problem: str) -> Lost:
        if key.is_root_key:
            region = self._grid.block_region(Block(0, key.row, key.col))
        else:
            region = self._grid.group_region(key)
        window = int(region.row), int(region.col), int(region.n_rows), int(region.n_cols)
        return Lost(key.level + 1, window, problem)
