"""Results of coding: of all units of a raster, or of a subtree that a journal or a depot keeps."""

import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field
from typing import Any, NamedTuple

from terrainwave.codec.refiner import Decoded, Heights
from terrainwave.container.writer import SpoolSink
from terrainwave.grid.block_stats import BlockStats
from terrainwave.grid.quadtree import Block, Region

Stats = dict[Block, BlockStats]


@dataclass
class Found:
    """Payloads and statistics of coded units, and what a patch changes; thread-safe.

    Payloads and voids go to `sink`. Without one they stay here, in `payloads` and `left_out`.

    Attributes
    ----------
    changes : dict
        Largest change of each block's decoded heights, in quanta, where anything changed.
    recoded : set
        Keys of the units that a patch codes again.
    apart_from : dict
        Largest distance of a changed coarse block's surface from finest heights that only the file
        knows, in quanta.
    """

    sink: SpoolSink | None = None
    payloads: dict[Block, bytes] = field(default_factory=dict)
    left_out: list[Block] = field(default_factory=list)
    stats: Stats = field(default_factory=dict)
    changes: dict[Block, int] = field(default_factory=dict)
    recoded: set[Block] = field(default_factory=set)
    apart_from: dict[Block, int] = field(default_factory=dict)
    has_corrections: bool = False
    lock: Any = field(default_factory=threading.Lock, repr=False)

    @property
    def repeat(self) -> Callable[[Block, Block], None] | None:
        """Return what records that a segment has the bytes of another, if the sink does."""
        return None if self.sink is None else self.sink.repeat

    def add(self, key: Block, payload: bytes) -> None:
        (self.payloads.__setitem__ if self.sink is None else self.sink)(key, payload)

    def leave_out(self, block: Block) -> None:
        """Record that all units below a block are void."""
        (self.left_out.append if self.sink is None else self.sink.leave_out)(block)

    def note(self, stats: Stats) -> None:
        with self.lock:
            for block, own in stats.items():
                self.stats.setdefault(block, BlockStats()).merge(own)

    def taken(self, blocks: list[Block]) -> Stats:
        """Remove and return the statistics of some blocks."""
        with self.lock:
            return {block: self.stats.pop(block) for block in blocks if block in self.stats}

    def note_apart(self, block: Block, apart: int) -> None:
        """Merge the distance of a changed block's surface."""
        with self.lock:
            self.apart_from[block] = max(apart, self.apart_from.get(block, 0))

    def take(self, other: "Found") -> None:
        for key, payload in other.payloads.items():
            self.add(key, payload)
        for block in other.left_out:
            self.leave_out(block)
        self.note(other.stats)
        for block, apart in other.apart_from.items():
            self.note_apart(block, apart)
        with self.lock:
            self.changes |= other.changes
            self.recoded |= other.recoded
            self.has_corrections |= other.has_corrections

    def to_bytes(self) -> bytes:
        values = {
            "left_out": self.left_out,
            "stats": [(*block, *astuple(own)) for block, own in self.stats.items()],
            "changes": [(*block, change) for block, change in self.changes.items()],
            "recoded": list(self.recoded),
            "apart_from": [(*block, apart) for block, apart in self.apart_from.items()],
            "has_corrections": self.has_corrections,
        }
        return packed(values, self.payloads)

    @classmethod
    def from_bytes(cls, data: bytes) -> "Found":
        values, payloads = unpacked(data)
        return cls(
            payloads=payloads,
            left_out=[Block(*block) for block in values["left_out"]],
            stats={Block(*row[:3]): BlockStats(*row[3:]) for row in values["stats"]},
            changes={Block(*block): change for *block, change in values["changes"]},
            recoded={Block(*key) for key in values["recoded"]},
            apart_from={Block(*block): apart for *block, apart in values["apart_from"]},
            has_corrections=values["has_corrections"],
        )


def packed(values: dict[str, Any], sections: Mapping[Block, bytes]) -> bytes:
    """Return values as a line of JSON, and sections of a file behind it."""
    lengths = [(*key, len(section)) for key, section in sections.items()]
    line = json.dumps({"lengths": lengths, **values}).encode()
    return b"\n".join([line, b"".join(sections.values())])


def unpacked(data: bytes) -> tuple[dict[str, Any], dict[Block, bytes]]:
    """Undo `packed`."""
    line, _, data = data.partition(b"\n")
    values, sections, offset = json.loads(line), dict[Block, bytes](), 0
    for *key, length in values["lengths"]:
        sections[Block(*key)] = data[offset : offset + length]
        offset += length
    return values, sections


class Ancestor(NamedTuple):
    """A decoded block above a unit, without its apron."""

    block: Block
    region: Region
    heights: Heights


class Start(NamedTuple):
    """Unit to code: its key, the decoded block above it, that block's ancestors and itself.

    `found` takes the results.
    """

    key: Block
    parent: Decoded | None
    chain: list[Ancestor]
    found: Found
