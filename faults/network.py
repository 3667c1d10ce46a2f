"""Read over http from a server that fails, stalls or lies, at every request of a session."""

import threading
import time
import warnings
from collections import Counter, namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import terrainwave
from faults.faulty_server import FAULTS, FaultyServer
from terrainwave.container.sources import url
from terrainwave.errors import TerrainwaveError

# Sessions that read what the file has, that end with one of our errors, or otherwise; of those
# whose fault passed, the ones that went on to read what the file has, or said that it changed.
Row = namedtuple(
    "Row",
    "fault at sessions right refused wrong others hangs then_right then_refused "
    "then_wrong slowest_s error",
)
PATIENCE = 30.0  # seconds, after which a session hangs
_TIMEOUT = 0.4  # seconds that the client waits for a byte; 30 as published
_DELAYS = (0.01, 0.02)  # seconds before it asks again; 0.2 and 1 as published
Heights = list[np.ndarray]
# Levels, and where windows of a quarter of their side begin, in shares of it.
WINDOWS = ((-1, 0.1, 0.2), (-2, 0.4, 0.1), (0, 0, 0), (-1, 0.7, 0.6))


def rows(path: Path, other: Path) -> Iterator[Row]:
    """Let each fault happen at each request of a session, once and from there on.

    `other` is the file that the server sends where it has replaced the first.
    """
    url.TIMEOUT, url._DELAYS = _TIMEOUT, _DELAYS
    warnings.simplefilter("ignore", terrainwave.TerrainwaveWarning)
    with terrainwave.open(path) as terrain, terrainwave.open(other) as another:
        expected, expected_of_other = _read(terrain), _read(another)
    with FaultyServer(path.read_bytes(), other.read_bytes()) as server:
        n_requests = max(_n_requests(server, expected) for _ in range(3))
        for fault in FAULTS:
            for lasts in (False, True):
                yield _row(server, (expected, expected_of_other), fault, n_requests, lasts=lasts)


def _n_requests(server: FaultyServer, expected: Heights) -> int:
    server.begin("", 0, lasts=False)
    session = _Session(server.url, expected)
    if session.run() != "right":
        raise RuntimeError(f"an undisturbed session ends with {session.error}")
    session.close()
    return server.n_requests


def _row(
    server: FaultyServer,
    files: tuple[Heights, Heights],
    fault: str,
    n_requests: int,
    *,
    lasts: bool,
) -> Row:
    found: Counter[str] = Counter()
    errors: set[str] = set()
    slowest = 0.0
    for first in range(n_requests):
        server.begin(fault, first, lasts=lasts)
        # Replaced before the first request: the other file is what there is.
        is_other = fault == "replaced" and lasts and first == 0
        session, start = _Session(server.url, files[is_other]), time.monotonic()
        found[session.run()] += 1
        slowest = max(slowest, time.monotonic() - start)
        if session.error:
            errors.add(type(session.error).__name__)
        if not lasts and session.is_open:
            found[f"then_{session.run()}"] += 1
        session.close()
    at = "from each on" if lasts else "each"
    counted = ("right", "refused", "wrong", "others", "hangs")
    then = ("then_right", "then_refused", "then_wrong")
    numbers = [found[field] for field in (*counted, *then)]
    names = " ".join(sorted(errors))
    return Row(fault, at, n_requests, *numbers, round(slowest, 2), names)


class _Session:
    """Opens a file and reads windows of it, in a thread that may hang."""

    def __init__(self, address: str, expected: Heights) -> None:
        self._address, self._expected = address, expected
        self._terrain: terrainwave.Terrain | None = None
        self.error: BaseException | None = None

    @property
    def is_open(self) -> bool:
        """Say whether the file could be opened."""
        return self._terrain is not None

    def run(self) -> str:
        """Return how it ended: right, wrong, refused, others or hangs."""
        self.error = None
        ends: list[str] = []
        thread = threading.Thread(target=lambda: ends.append(self._ended()), daemon=True)
        thread.start()
        thread.join(PATIENCE)
        return ends[0] if ends else "hangs"

    def _ended(self) -> str:
        try:
            if self._terrain is None:
                self._terrain = terrainwave.open(self._address, threads=2)
            found = _read(self._terrain)
        except TerrainwaveError as error:
            self.error = error
            return "refused"
        except BaseException as error:  # noqa: BLE001  what nobody expects is counted
            self.error = error
            return "others"
        is_right = all(map(np.array_equal, found, self._expected))
        return "right" if is_right else "wrong"

    def close(self) -> None:
        """Close the file."""
        if self._terrain is not None:
            self._terrain.close()


def _read(terrain: terrainwave.Terrain) -> Heights:
    windows = []
    for level, *place in WINDOWS:
        shape = terrain.info().level_shapes[level]
        row, col = (int(share * n) for share, n in zip(place, shape, strict=True))
        windows.append((level, (row, col, -(-shape[0] // 4), -(-shape[1] // 4))))
    return [terrain.read(window=window, level=level) for level, window in windows]
