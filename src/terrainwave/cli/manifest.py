"""Record of a batch's results in a directory, so that the next run skips unchanged ones.

The file has one JSON object per line and target; the last entry of a name counts. It only saves
work: a target that is not listed, or whose files have another size or time, is compared with its
source, or made again.
"""

import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from terrainwave.progress import ProgressCallback

NAME = ".terrainwave-manifest.jsonl"
UNKNOWN = "no manifest says what it was made of"

# Takes source, target, and the difference found by the manifest; returns why the target is not what
# the command makes of the source, None if it is.
Compare = Callable[[str, str, str, ProgressCallback], str | None]


class Manifest:
    """Targets in a directory, and their sources.

    `compare` is for existing targets that the manifest does not confirm. Without `skips`, targets
    are only recorded.
    """

    def __init__(
        self,
        directory: str,
        asked: dict[str, Any],
        *,
        files_of: Callable[[str], list[str]],
        compare: Compare,
        skips: bool = True,
    ) -> None:
        self._path = Path(directory) / NAME
        self._asked = json.loads(json.dumps(asked, default=str))
        self._files_of = files_of
        self._compare = compare
        self._skips = skips
        self._lock = threading.Lock()
        self._entries = _read_entries(self._path) if skips else {}

    @contextmanager
    def checked(self, source: str, target: str, progress: ProgressCallback) -> Iterator[str | None]:
        """Yield why a target has to be made again ("" if it is new); None if it is up to date.

        The target is recorded when the block ends without an exception.
        """
        # Taken before the source is read, so that the next run notices changes made meanwhile.
        sources = self._source_states(source)
        name = os.path.relpath(target, self._path.parent).replace(os.sep, "/")
        before = self._entries.get(name)
        entry = {"target": name, "asked": self._asked, "sources": sources}
        difference: str | None = ""
        if self._skips and os.path.exists(target):
            known = _difference(before, entry | {"state": _state(target)})
            difference = known and self._compare(source, target, known, progress)
        yield difference
        entry["state"] = _state(target)
        if sources is not None and entry != before:
            self._write(entry)

    def _source_states(self, source: str) -> list[list[Any]] | None:
        from terrainwave.errors import TerrainwaveError

        try:
            names = self._files_of(source)
            # Includes the time of change: copying tools copy the time of modification.
            return [
                [os.path.abspath(name), *_state(name), os.stat(name).st_ctime_ns] for name in names
            ] or None
        except (TerrainwaveError, OSError):  # reading reports it, or it is not a local file
            return None

    def _write(self, entry: dict[str, Any]) -> None:
        """Append a line; without it, the next run compares the files themselves."""
        # The line feed comes first: a truncated line spoils no other.
        line = "\n" + json.dumps(entry, ensure_ascii=True, sort_keys=True)
        with self._lock:
            self._entries[entry["target"]] = entry
            with suppress(OSError), self._path.open("a", encoding="ascii") as file:
                file.write(line)


def _difference(before: dict[str, Any] | None, now: dict[str, Any]) -> str | None:
    if before is None:
        return UNKNOWN
    if before.get("asked") != now["asked"]:
        return "it was made with other options"
    if now["sources"] is None or before.get("sources") != now["sources"]:
        return "its source has changed"
    return None if before.get("state") == now["state"] else "it has changed since it was made"


def _state(path: str) -> list[int]:
    found = os.stat(path)
    return [found.st_size, found.st_mtime_ns]


def _read_entries(path: Path) -> dict[str, dict[str, Any]]:
    entries: dict[str, dict[str, Any]] = {}
    try:
        lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return entries
    for line in filter(None, lines):
        with suppress(ValueError, RecursionError):
            entry = json.loads(line)
            if isinstance(entry, dict) and isinstance(entry.get("target"), str):
                entries[entry["target"]] = entry
    return entries
