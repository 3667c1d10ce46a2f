"""Sources on storage that several machines share: what fails for a moment is asked for again."""

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from terrainwave.container.sources.addresses import display_name
from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.sources.opening import open_source
from terrainwave.errors import StorageError

_log = logging.getLogger(__name__)

CHUNK = 16 << 20  # bytes to copy at a time
# Seconds before a retry: stores may show new objects late.
_DELAYS = (0.2, 1.0, 5.0, 15.0)

Result = TypeVar("Result")


def repeated(what: str, call: Callable[[], Result]) -> Result:
    """Return the result of a call, retried if it fails."""
    for delay in _DELAYS:
        try:
            return call()
        except (StorageError, OSError) as error:
            _log.info("%s: %s, again in %g s", what, type(error).__name__, delay)
            time.sleep(delay)
    return call()


class SharedSource:
    """A source that may appear late; failed reads are retried."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._source: ByteSource = self._again(lambda: open_source(path))

    @property
    def size(self) -> int:
        """Return the number of bytes."""
        return self._source.size

    def read(self, offset: int, length: int) -> bytes:
        """Return exactly these bytes."""
        return self._again(lambda: self._source.read(offset, length))

    def close(self) -> None:
        self._source.close()

    def _again(self, call: Callable[[], Result]) -> Result:
        return repeated(f"reading {display_name(self._path)}", call)
