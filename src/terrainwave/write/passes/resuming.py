"""Unfinished work of `compress` or `patch`, kept for the next run of the same command.

Stages over windows record how many are done (`Kept.each`), coding keeps finished subtrees
(`KeptUnits`), the proof its result for each share of the file's bytes.
"""

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from terrainwave._version import __version__
from terrainwave.container.targets.kept import Kept, kept_directory
from terrainwave.errors import TerrainwaveWarning
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.raster_io.dataset import stamps_of
from terrainwave.write.passes.found import Found

_log = logging.getLogger(__name__)

# Smaller rasters take seconds: their work is not kept.
LEAST_SAMPLES = 1 << 26
# Side, in samples, of the subtrees between two records of the journal: about a quarter of a second
# of one thread, and some MB of payloads in memory.
SUBTREE_SIDE = 2048

_SOURCE, _ASKED = "source", "asked"
_OTHER_SOURCE = "the source was another one, or has changed"
_NAMES = {
    _SOURCE: _OTHER_SOURCE,
    _ASKED: _OTHER_SOURCE,
    "version": "it was made by another version of terrainwave",
}


@contextmanager
def run_directory(
    parent: str | os.PathLike[str],
    target: Path,
    src: Any,
    shape: tuple[int, int],
    depends_on: dict[str, Any],
    *,
    fresh: bool,
    is_kept: bool = True,
    by_heights: bool = False,
) -> Iterator[tuple[Path, Kept]]:
    """Yield a directory for temporary files, and the finished work of earlier runs.

    Files of `src`, one source or a list, are the same if their names, sizes and times are. Of other
    sources work is kept only `by_heights`: then the caller compares a digest of the heights
    (`is_by_heights`). `depends_on` is all else that the result depends on, as plain values for
    JSON. Nobody else writes `target`, an absolute path, meanwhile.
    """
    run = None
    if is_kept and shape[0] * shape[1] >= LEAST_SAMPLES:
        stamps = stamps_of(src)
        if by_heights or stamps is not None:
            asked = [_asked_for(src), list(shape)]
            run = {"version": __version__, _SOURCE: stamps, _ASKED: asked, **depends_on}
    with kept_directory(parent, target, run, fresh=fresh) as (directory, kept):
        if kept.other is not None:
            note_that_removed(_difference(kept.other, run or {}))
        if kept.n_found:
            _log.info("%s: continues from %d records in %s", target, kept.n_found, directory)
        yield directory, kept


def _asked_for(src: Any) -> Any:
    """Return the properties of a source besides its files: names as given, order, open options."""
    if isinstance(src, list | tuple):
        return [_asked_for(one) for one in src]
    if isinstance(src, str | os.PathLike):
        return os.fspath(src)
    return [type(src).__name__, str(getattr(src, "name", ""))]


def note_that_removed(why: str) -> None:
    warnings.warn(
        TerrainwaveWarning(f"unfinished work of an earlier run is removed: {why}"), stacklevel=2
    )


def taken_up(kept: Kept) -> list[str]:
    """Return notes for the user on work that was continued."""
    if not kept.n_found:
        return []
    return ["the run continued the work of an earlier one; `fresh` starts over"]


def _difference(other: dict[str, Any], run: dict[str, Any]) -> str:
    for name, reason in _NAMES.items():
        if other.get(name) != run.get(name):
            return reason
    return "it was made with other options"


def is_by_heights(kept: Kept) -> bool:
    """Return whether only a digest of the heights identifies the source."""
    return kept.is_on and kept.run[_SOURCE] is None


def same_heights(kept: Kept, digest: str) -> None:
    """Store the digest of a source without another identity; remove work on other heights."""
    found = kept.get("heights")
    if found is not None and found != {"digest": digest}:
        kept.clear()
        note_that_removed(_OTHER_SOURCE)
    kept.put("heights", {"digest": digest})


class KeptUnits:
    """Subtrees of coded units in a journal, by names that begin with `name`, of what codes them."""

    def __init__(self, kept: Kept, grid: Grid, name: str) -> None:
        self._kept, self._name = kept, name
        # The coarsest level whose blocks are no wider; -1 if nothing is kept.
        sides = enumerate(grid.block * grid.stride(level) for level in range(grid.k_max))
        levels = (level for level, side in sides if side <= SUBTREE_SIDE)
        self.level = next(levels, -1) if kept.is_on else -1

    def load(self, head: Block) -> Found | None:
        """Return the results of the units below a block; None if missing."""
        name = self._name_of(head)
        return None if self._kept.get(name) is None else Found.from_bytes(self._kept.data(name))

    def save(self, head: Block, found: Found) -> None:
        self._kept.put(self._name_of(head), {}, found.to_bytes())

    def _name_of(self, head: Block) -> str:
        return f"{self._name}/{head.level}/{head.row}/{head.col}"
