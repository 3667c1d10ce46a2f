"""A factor of τ that keeps meshes within a budget of vertices from frame to frame."""

from terrainwave.errors import InvalidHeightsError

# Where there are too many vertices, τ is raised by steps; it sinks again by smaller ones.
_RISE, _RELIEF = 1.1, 1.02
# No view is shown coarser; what is around the eye has no error small enough.
_LARGEST = 1e6


def check_budget(max_vertices: int | None, least: int, what: str) -> None:
    """Refuse a budget below the vertices that there always are, one per `what`.

    Raises
    ------
    InvalidHeightsError
        If it is smaller.
    """
    if max_vertices is not None and max_vertices < least:
        raise InvalidHeightsError(
            f"found max_vertices {max_vertices}, expected at least one per {what}: {least}"
        )


class Pressure:
    """A factor of τ, at least 1, that rises at once and sinks slowly.

    Attributes
    ----------
    factor : float
    """

    def __init__(self) -> None:
        self.factor = 1.0

    def relieve(self) -> None:
        """Let it sink by a step; once a frame."""
        self.factor = max(self.factor / _RELIEF, 1.0)

    def rise(self) -> bool:
        """Raise it by a step; false if it is as large as it may be."""
        if self.factor >= _LARGEST:
            return False
        self.factor *= _RISE
        return True
