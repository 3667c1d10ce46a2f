"""Every finest block, a part at a time: the reference that the others are compared with."""

from terrainwave.render.modes.adaptive import Adaptive


class Full(Adaptive):
    """The finest blocks of `Adaptive`, without levels of detail."""

    name = "full"
    is_partwise = True

    def split_error(self, tau: float) -> float:
        """Return a negative error: all pieces are split."""
        return -1.0
