"""All finest blocks, a part at a time: the reference for comparisons."""

from terrainwave.render.modes.adaptive import Adaptive


class Full(Adaptive):
    """The finest blocks of `Adaptive`, without levels of detail."""

    name = "full"
    options = ()
    is_partwise = True

    @property
    def is_bound(self) -> bool:
        return True

    @classmethod
    def preparation(cls, error: str) -> str | None:  # noqa: ARG003, as in `Mode`
        return None

    def _recursive_errors(self) -> None:
        """Return None: errors select nothing here."""

    def split_error(self, tau: float) -> float:  # noqa: ARG002, as in `Mode`
        return -1.0
