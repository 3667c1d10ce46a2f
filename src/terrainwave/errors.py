"""Exceptions raised at the public boundary.

TerrainwaveError
├── InvalidHeightsError       (also ValueError) input that cannot be encoded as requested
│   └── InvalidArgumentError  an argument, or a combination, is invalid
├── CorruptStreamError        the bytes contradict docs/FORMAT.md
│   └── TruncatedStreamError  the bytes stop too early
├── BoundViolationError       a decoded sample is further from the original than promised
├── LimitExceededError        legal, but larger than the caller allowed
├── UnsupportedVersionError   the bytes need a newer terrainwave
└── StorageError              (also OSError) a file cannot be read or written
    └── SourceUnavailableError  not now: the server cannot be reached, is busy or hung up

TerrainwaveWarning            (a UserWarning) something of the input is left out, and what; or
                              compiled kernels are not kept, or made in another way
"""

import re
from collections.abc import Callable

# Names of arguments in messages; the command line calls them otherwise.
_ARGUMENT = re.compile("`([a-z_]+)`")


class _NamesArguments(Exception):
    """Error whose message names arguments in backquotes.

    `str` gives Python's names of arguments, `message_with` those of another interface.
    """

    def __str__(self) -> str:
        return self.message_with(str)

    def message_with(self, called: Callable[[str], str]) -> str:
        """Return the message with each argument's name as `called` writes it."""
        return _ARGUMENT.sub(lambda found: called(found[1]), super().__str__())


class TerrainwaveError(_NamesArguments):
    """Base class of every error this package raises on purpose."""


class InvalidHeightsError(TerrainwaveError, ValueError):
    """The heights or an option cannot be used for the request."""


class InvalidArgumentError(InvalidHeightsError):
    """An argument, or a combination of arguments, is invalid; no heights have been read."""


class CorruptStreamError(TerrainwaveError):
    """The file is damaged: its bytes contradict docs/FORMAT.md."""


class TruncatedStreamError(CorruptStreamError):
    """The file is damaged: it ends before its data are complete."""


class BoundViolationError(TerrainwaveError):
    """A decoded sample is further from the original than promised."""


class LimitExceededError(TerrainwaveError):
    """The request is legal but larger than the caller, or the memory, allows.

    On the command line this is a failure (status 1), not wrong usage: another file or
    machine may do.
    """


class UnsupportedVersionError(TerrainwaveError):
    """The file needs a newer version of terrainwave."""


class StorageError(TerrainwaveError, OSError):
    """A file, directory or URL cannot be read or written; the target is untouched."""


class SourceUnavailableError(StorageError):
    """A server could not be reached, was busy or closed the connection; it may answer later."""


class ClusterError(TerrainwaveError):
    """The cluster cannot be reached, or lost its work; nothing is written."""


class TerrainwaveWarning(_NamesArguments, UserWarning):
    """Something in the input is ignored or dropped; the heights are not affected."""
