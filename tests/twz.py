"""Small .twz files in memory."""

import tempfile
from pathlib import Path

from terrainwave.write.compress import compress


def twz_bytes(heights, **options):
    """Return the bytes of the file that `compress` makes of an array or a path."""
    with tempfile.TemporaryDirectory() as directory:
        target = Path(directory) / "small.twz"
        compress(heights, target, **{"block": 32, "threads": 1, **options})
        return target.read_bytes()
