"""Opening of byte sources: a path, a URL, bytes, a file object."""

import os
from typing import BinaryIO, TypeAlias

from terrainwave.arguments import checked_path, shown
from terrainwave.container.sources.byte_source import BufferSource, ByteSource, FileSource
from terrainwave.errors import InvalidArgumentError

SourceLike: TypeAlias = str | os.PathLike[str] | bytes | BinaryIO | ByteSource


def open_source(source: SourceLike) -> ByteSource:
    """Return the source of a path, a URL, bytes or a binary file object, or raise."""
    if isinstance(source, bytes | bytearray | memoryview):
        return BufferSource(bytes(source))
    if isinstance(source, str) and "://" in source:
        from terrainwave.container.sources.url import open_url

        return open_url(source)
    if isinstance(source, str | os.PathLike):
        return FileSource(checked_path(source))
    if isinstance(source, ByteSource):
        return source
    if hasattr(source, "read") and hasattr(source, "seek"):
        return BufferSource(source)
    raise InvalidArgumentError(
        f"found {shown(source)}, expected the path or URL of a .twz file, its bytes, or a binary"
        " file object"
    )
