"""Index pages: positions of one segment's payloads, and its child segments (FORMAT.md §3.3)."""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, chain, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.deflate import deflate, inflate
from terrainwave.container.header import MAX_PAGE, NEWER
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.errors import CorruptStreamError, UnsupportedVersionError
from terrainwave.grid.quadtree import SEGMENT_LEVELS, Block, Grid

N_CODES = 4
MAX_PAYLOAD = 2**31 - 1

_PREFIX = struct.Struct("<I Q")
_MIN_PAGE = _PREFIX.size + 1


class _Lists(NamedTuple):
    keys: list[Block]
    blocks: list[Block]
    children: list[Block]


class PageLayout(_Lists):
    """Rows of a segment's page, in order; determined by the grid."""

    @cached_property
    def order(self) -> list[int]:
        """Return the rows of keys in the order of their payloads in the file."""
        return file_order(self.keys)

    @cached_property
    def keys_in_file(self) -> list[Block]:
        return [self.keys[row] for row in self.order]

    @cached_property
    def key_rows(self) -> dict[Block, int]:
        return {key: row for row, key in enumerate(self.keys)}

    @cached_property
    def block_rows(self) -> dict[Block, int]:
        return {block: row for row, block in enumerate(self.blocks)}

    @cached_property
    def child_rows(self) -> dict[Block, int]:
        return {child: row for row, child in enumerate(self.children)}


@lru_cache(maxsize=32)
def page_layout(grid: Grid, head: Block | None) -> PageLayout:
    """Return the keys on the page of the segment of `head` (FORMAT.md §3.3), shared and constant.

    At most 85 keys, 340 blocks and 256 children, whatever the size of the grid.
    """
    # In one walk, as a key's blocks are the next layer's keys, or the children of the last layer.
    if head is None:
        layers = [grid.blocks(level) for level in range(grid.top_levels + 1)]
        keys = grid.root_keys()
        blocks = list(layers[0])
    else:
        layers, keys, blocks = [[head]], [], []
        for _ in range(SEGMENT_LEVELS):
            layers.append(grid.all_children(layers[-1]))
    for layer, next_layer in pairwise(layers):
        keys += layer
        blocks += next_layer
    children = layers[-1] if layers[-1][0].level < grid.k_max else []
    return PageLayout(keys, blocks, children)


@dataclass(frozen=True)
class Page:
    """The columns of an index page; rows in the order of its `PageLayout`.

    `codes`, shape (n_blocks, 4), are z_min, z_max, error and mesh error of each block, opaque here.
    `child_lengths` are page and body of a child, 0 if the segment is absent; the bodies are
    contiguous from the offset `first_child` on, which is 0 if the layout has no children.
    """

    payload_lengths: NDArray[np.uint32]
    payload_crcs: NDArray[np.uint32]
    mesh_lengths: NDArray[np.uint32]
    mesh_crcs: NDArray[np.uint32]
    flags: NDArray[np.uint8]
    codes: NDArray[np.uint8]
    child_page_lengths: NDArray[np.uint32]
    child_lengths: NDArray[np.uint64]
    first_child: int = 0

    @property
    def sections_length(self) -> int:
        return int(self.payload_lengths.sum(dtype=np.int64) + self.mesh_lengths.sum(dtype=np.int64))

    @property
    def body_length(self) -> int:
        return int(self.child_page_lengths.sum(dtype=np.int64)) + self.sections_length

    @property
    def child_body_lengths(self) -> list[int]:
        # Not numpy's difference: untrusted uint64 could wrap.
        pages = self.child_page_lengths.tolist()
        return [
            length - page for length, page in zip(self.child_lengths.tolist(), pages, strict=True)
        ]

    @property
    def children_end(self) -> int:
        return self.first_child + sum(self.child_body_lengths)

    @property
    def is_empty(self) -> bool:
        """Return whether the segment can be left out without loss (FORMAT.md §3.4)."""
        return not (
            self.sections_length or self.flags.any() or self.codes.any() or self.child_lengths.any()
        )


# Columns in the order of the file, the type of their numbers, and whose rows they are: of keys,
# blocks or children. The codes of a block are packed as one number.
_COLUMNS = (
    ("payload_lengths", "<u4", 0), ("mesh_lengths", "<u4", 0), ("flags", "u1", 0),
    ("codes", "<u4", 1), ("child_page_lengths", "<u4", 2), ("child_lengths", "<u8", 2),
    ("payload_crcs", "<u4", 0), ("mesh_crcs", "<u4", 0),
)  # fmt: skip


def empty_page(layout: PageLayout) -> Page:
    """Return the page of an absent segment: zeros everywhere (FORMAT.md §3.4)."""
    zeros: dict[str, Any] = {
        name: np.zeros(len(layout[rows]), dtype) for name, dtype, rows in _COLUMNS
    }
    return Page(**zeros | {"codes": np.zeros((len(layout.blocks), N_CODES), dtype=np.uint8)})


def pack_columns(page: Page) -> bytes:
    """Return the deflated columns of `page` except `first_child` (FORMAT.md §3.3)."""
    return deflate(b"".join(_planes(page, name, dtype) for name, dtype, _ in _COLUMNS))


def _planes(page: Page, name: str, dtype: str) -> bytes:
    """Return all lowest bytes, then all second ones, ...: similar bytes together deflate better."""
    column: NDArray[np.generic] = getattr(page, name)
    column = np.ascontiguousarray(column if name == "codes" else column.astype(dtype))
    return column.view(np.uint8).reshape(len(column), -1).T.tobytes() if len(column) else b""


def page_length(columns: bytes) -> int:
    return _PREFIX.size + len(columns)


def pack_page(columns: bytes, first_child: int) -> bytes:
    """Return the bytes of a page from its packed columns (FORMAT.md §3.3).

    `first_child` is not deflated: lengths of pages must not depend on offsets.
    """
    body = _PREFIX.pack(0, first_child)[4:] + columns
    return zlib.crc32(body).to_bytes(4, "little") + body


def unpack_page(data: bytes, layout: PageLayout, name: str) -> Page:
    """Read and check a page (FORMAT.md §3.3), but not the positions of its segments."""
    if len(data) < _MIN_PAGE:
        raise CorruptStreamError(f"{name} has only {len(data)} bytes")
    crc, first_child = _PREFIX.unpack_from(data)
    if crc != zlib.crc32(data[4:]):
        raise CorruptStreamError(f"checksum of {name} does not match")
    sizes = {name: (np.dtype(kind).itemsize, len(layout[rows])) for name, kind, rows in _COLUMNS}
    expected = sum(width * count for width, count in sizes.values())
    content = inflate(data[_PREFIX.size :], expected, name)
    if len(content) != expected:
        raise CorruptStreamError(f"{name} inflates to {len(content)} bytes, not {expected}")
    columns, at = dict[str, Any](), 0
    for column, dtype, _ in _COLUMNS:
        width, count = sizes[column]
        planes = np.frombuffer(content, np.uint8, width * count, at).reshape(width, count)
        at += planes.size
        rows = np.ascontiguousarray(planes.T)
        if column != "codes":
            rows = rows.view(dtype).reshape(count).astype(np.dtype(dtype).newbyteorder("="))
        columns[column] = rows
    page = Page(first_child=first_child, **columns)
    _check(page, name)
    return page


def _check(page: Page, name: str) -> None:
    if page.flags.any():
        raise UnsupportedVersionError(f"{name} has flags that this version does not know{NEWER}")
    for kind, lengths, crcs in (
        ("payload", page.payload_lengths, page.payload_crcs),
        ("mesh", page.mesh_lengths, page.mesh_crcs),
    ):
        if (lengths > MAX_PAYLOAD).any():
            raise CorruptStreamError(f"{name} lists a {kind} of more than 2^31 - 1 bytes")
        if crcs[lengths == 0].any():
            raise CorruptStreamError(f"{name} lists an empty {kind} with a checksum")
    absent = page.child_lengths == 0
    if (absent != (page.child_page_lengths == 0)).any():
        raise CorruptStreamError(f"{name} lists a segment without page or a page without segment")
    present = page.child_page_lengths[~absent]
    if ((present < _MIN_PAGE) | (present > MAX_PAGE)).any():
        raise CorruptStreamError(f"{name} lists a page that is not {_MIN_PAGE} ... 2^15 bytes")
    if (page.child_lengths < page.child_page_lengths).any():
        raise CorruptStreamError(f"{name} lists a segment shorter than its page")
    if page.first_child and not len(absent):
        raise CorruptStreamError(f"{name} points at segments below the finest level")


def describe_head(head: Block | None) -> str:
    if head is None:
        return "the top segment"
    return f"the segment of block (level {head.level}, row {head.row}, col {head.col})"


def describe_key(key: Block) -> str:
    if key.is_root_key:
        return f"root block (level 0, row {key.row}, col {key.col})"
    return f"group (level {key.level}, row {key.row}, col {key.col})"


def file_order(keys: Sequence[Block]) -> list[int]:
    """Return the rows of a segment's page in the order of their payloads (FORMAT.md §3.2).

    Keys of the second level are followed by their children, and the fourth level is reversed: a
    window then needs fewer ranges.
    """
    layers: list[list[int]] = [[] for _ in range(SEGMENT_LEVELS)]
    for row, key in enumerate(keys):
        layers[key.level - keys[0].level].append(row)
    first, second, third, fourth = layers
    below: dict[Block, list[int]] = {keys[row]: [row] for row in second}
    for row in third:
        below[keys[row].parent].append(row)
    return [*first, *chain.from_iterable(below.values()), *reversed(fourth)]


def payload_starts(page: Page, layout: PageLayout, start: int) -> Sequence[int]:
    """Return the offset of each key's payload, which its mesh follows (FORMAT.md §3.2)."""
    order = layout.order
    lengths = (page.payload_lengths.astype(np.int64) + page.mesh_lengths)[order]
    starts = np.empty(len(order), dtype=np.int64)
    starts[order] = start + np.cumsum(lengths) - lengths
    offsets: list[int] = starts.tolist()
    return offsets


@dataclass(frozen=True)
class Segment:
    """Index page of a segment with the positions of its payloads, meshes and children.

    Its payloads and meshes lie from `sections_start` to `end`; `page_starts` and `child_starts` are
    those of its children's pages and bodies.
    """

    head: Block | None
    layout: PageLayout
    page: Page
    sections_start: int
    end: int
    payload_starts: Sequence[int]
    page_starts: Sequence[int]
    child_starts: Sequence[int]

    def payload_range(self, row: int) -> ByteRange:
        return ByteRange(self.payload_starts[row], int(self.page.payload_lengths[row]))

    def mesh_range(self, row: int) -> ByteRange:
        return ByteRange(self.payload_range(row).end, int(self.page.mesh_lengths[row]))

    def codes(self, block: Block) -> tuple[int, int, int, int]:
        z_min, z_max, error, mesh_error = self.page.codes[self.layout.block_rows[block]].tolist()
        return z_min, z_max, error, mesh_error

    def page_range(self, child: Block) -> ByteRange:
        row = self.layout.child_rows[child]
        return ByteRange(self.page_starts[row], int(self.page.child_page_lengths[row]))

    def child_range(self, child: Block) -> ByteRange:
        row = self.layout.child_rows[child]
        return ByteRange(self.child_starts[row], self.page.child_body_lengths[row])


def segment_of_page(head: Block | None, layout: PageLayout, page: Page, body_start: int) -> Segment:
    pages = page.child_page_lengths.tolist()
    sections_start = body_start + sum(pages)
    return Segment(
        head=head,
        layout=layout,
        page=page,
        sections_start=sections_start,
        end=sections_start + page.sections_length,
        payload_starts=payload_starts(page, layout, sections_start),
        page_starts=list(accumulate(pages, initial=body_start))[:-1],
        child_starts=list(accumulate(page.child_body_lengths, initial=page.first_child))[:-1],
    )


# Of a mesh above the finest level whose error is not measured: its bound is computed with the mesh.
# As an error it exceeds that of any mesh, as the format requires (FORMAT.md §4.4).
UNMEASURED = 255


# An error code c means (8 + c % 8) * 2^(c // 8) / 8, rounded down: eight steps an octave.
def encode_error(error: int) -> int:
    """Return the smallest code of an error of at least `error` quanta (0 … 2^31)."""
    if error <= 0:
        return 0
    exponent = max(error.bit_length() - 1, 0)
    for code in range(8 * exponent, 8 * exponent + 9):
        if code and decode_error(code) >= error:
            return min(code, 255)
    return 255


def decode_error(code: int) -> int:
    """Return the error in quanta of `code` (0 … 255)."""
    return 0 if code == 0 else ((8 + code % 8) << code // 8) >> 3


def encode_range(low: int, high: int, outer_low: int, outer_high: int) -> tuple[int, int]:
    span = outer_high - outer_low
    if span <= 0 or low > high:
        return 0, 0
    below = (low - outer_low) * 255 // span
    above = (outer_high - high) * 255 // span
    return min(max(below, 0), 255), min(max(above, 0), 255)


def decode_range(below: int, above: int, outer_low: int, outer_high: int) -> tuple[int, int]:
    span = outer_high - outer_low
    return outer_low + below * span // 255, outer_high - above * span // 255
