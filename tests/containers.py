"""Files opened without a `TerrainFile`: their bytes, and no heights."""

from terrainwave.container.reader import Container
from terrainwave.container.sources.opening import open_source


def open_container(source):
    """Return a `Container` of a path, URL, bytes or binary file object."""
    opened = open_source(source)
    try:
        return Container(opened)
    except BaseException:
        opened.close()
        raise
