"""Exceptions raised at the public boundary.

TerrainwaveError
├── InvalidHeightsError       (also ValueError) input that cannot be encoded as asked
│   └── InvalidArgumentError  an argument, or two together, cannot be
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

# How messages write the name of an argument, which the command line calls otherwise.
_ARGUMENT = re.compile("`([a-z_]+)`")


class _NamesArguments(Exception):
    """A message that names arguments in backquotes.

    `str` gives the names as Python has them, `message_with` as someone else calls them.
    """

    def __str__(self) -> str:
        return self.message_with(str)

    def message_with(self, called: Callable[[str], str]) -> str:
        """Return the message with each argument's name as `called` writes it."""
        return _ARGUMENT.sub(lambda found: called(found[1]), super().__str__())


class TerrainwaveError(_NamesArguments):
    """Base class of every error this package raises on purpose."""


class InvalidHeightsError(TerrainwaveError, ValueError):
    """The heights or an option cannot be used for what was asked."""


class InvalidArgumentError(InvalidHeightsError):
    """An argument is invalid, or two do not go together; no heights have been read."""


class CorruptStreamError(TerrainwaveError):
    """The file is damaged: its bytes contradict docs/FORMAT.md."""


class TruncatedStreamError(CorruptStreamError):
    """The file is damaged: it ends before its data are complete."""


class BoundViolationError(TerrainwaveError):
    """A decoded sample is further from the original than promised."""


class LimitExceededError(TerrainwaveError):
    """The request is legal but larger than the caller allowed, or than there is memory for.

    On the command line a failure (status 1), not wrong usage: it fits another file or machine.
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
    """Something of the input is ignored or dropped; the heights are not affected."""
