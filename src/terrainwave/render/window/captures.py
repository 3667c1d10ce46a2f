"""Files written by a viewer: pictures, flights, profiles, under unused names."""

import json
import os
import threading
import time
from pathlib import Path

from terrainwave.container.targets.publication import publish
from terrainwave.errors import StorageError

# A flight has a key at these intervals, so that `render --flight` flies it evenly.
_KEY_SECONDS = 0.5
_MOST_KEYS = 100_000
_ATTEMPTS = 1000
# Two files at once would get the same name.
_NAMING = threading.Lock()


def save_as_new(data: bytes, stem: str, ending: str, folder: str | os.PathLike[str] = ".") -> str:
    """Write a file ``stem-date-time.ending``, numbered if it exists; return its name."""
    first = f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}"
    with _NAMING:
        for number in range(1, _ATTEMPTS):
            name = f"{first}{'' if number == 1 else f'-{number}'}{ending}"
            path = Path(folder) / name
            if not os.path.lexists(path):
                with publish(path) as part:
                    part.file.write(data)
                return name
    raise StorageError(f"{first}{ending}: all numbers up to {_ATTEMPTS} are taken")


class FlightRecorder:
    """Cameras of a flight, one each half second."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.seconds = 0.0
        self._since_key = _KEY_SECONDS

    def tick(self, seconds: float, camera_line: str) -> None:
        """Add the time since the last frame and the camera's position."""
        self.seconds += seconds
        self._since_key += seconds
        if self._since_key >= _KEY_SECONDS and len(self.lines) < _MOST_KEYS:
            self._since_key = min(self._since_key - _KEY_SECONDS, _KEY_SECONDS)
            self.lines.append(camera_line)

    def to_json(self) -> str:
        """Return the input of ``terrainwave render --flight``."""
        return json.dumps(self.lines, indent=1) + "\n"
