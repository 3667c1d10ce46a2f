"""What has been logged: a damaged file is one line, not one for each request that meets it."""

from terrainwave.cache import Cache

# Of the last causes: a file may be damaged in many places.
_N_CAUSES = 1000


class Causes:
    """The last causes that were logged."""

    def __init__(self) -> None:
        self._known: Cache[str, bool] = Cache(_N_CAUSES)

    def is_new(self, cause: str) -> bool:
        """Say whether a cause is to be logged: it has not been, as far back as is known."""
        is_new = self._known.get(cause) is None
        self._known.put(cause, True)
        return is_new
