"""Status codes that kernels return, and the exceptions they become."""

from enum import IntEnum

from terrainwave.errors import CorruptStreamError, TruncatedStreamError


class Status(IntEnum):
    """Result of a kernel; `OK` is 0."""

    OK = 0
    TRUNCATED = 1
    TRAILING = 2
    BAD_VALUE = 3


_FAILURES = {
    Status.TRUNCATED: (TruncatedStreamError, "the payload ends inside its data"),
    Status.TRAILING: (CorruptStreamError, "bytes are left over after the last symbol"),
    Status.BAD_VALUE: (CorruptStreamError, "a decoded value is outside its range"),
}


def raise_for_status(status: int, byte_pos: int) -> None:
    """Raise the exception of `status`; return if it is ``OK``."""
    if status == Status.OK:
        return
    error, problem = _FAILURES[Status(status)]
    raise error(f"{problem} (byte {byte_pos} of the section)")
