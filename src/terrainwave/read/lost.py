"""Unreadable parts of a damaged file."""

from dataclasses import dataclass
from typing import Any, NamedTuple


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
