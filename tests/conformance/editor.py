"""Take a .twz file apart and put it together again, whatever is in it (FORMAT.md §3, §4).

Lengths and checksums are made to match, unless they are what is to be wrong.
"""

import json
import struct
import zlib

from terrainwave.reference.basics import inflate
from terrainwave.reference.files import (
    DICTIONARY,
    HEADER,
    NAMES,
    file_order,
    read_page,
    segment_layout,
)
from terrainwave.reference.grid import Grid

COLUMNS = {
    "payload_length": 4, "mesh_length": 4, "flags": 1, "z_min": 1, "z_max": 1, "error": 1,
    "mesh_error": 1, "child_page_length": 4, "child_length": 8, "payload_crc": 4, "mesh_crc": 4,
}  # fmt: skip


def planes(values, width):
    """§3.3: all lowest bytes, then the second ones, …"""
    return b"".join(bytes(value >> 8 * p & 255 for value in values) for p in range(width))


def deflated(text):
    """Return text as the metadata section holds it (§4.2)."""
    stream = zlib.compressobj(9, zlib.DEFLATED, -15, zdict=DICTIONARY)
    return stream.compress(text) + stream.flush()


class Segment:
    """One segment: what its page lists, and what is to be changed there."""

    def __init__(self, head, layout):
        self.head, self.layout = head, layout
        self.payloads, self.meshes = {}, {}
        self.columns = None
        self.children = []  # segments, or None where absent
        self.change_columns = lambda columns: None
        self.change_page = lambda page: page
        self.pack = lambda columns: zlib.compress(columns, 9)
        self.first_child = None


class Editor:
    """The parts of a file, to be changed; `bytes` puts them together.

    Attributes
    ----------
    header : dict
        Fields that are to differ from the file's own; lengths and checksums too.
    optional, metadata, parameters : bytes
    top : Segment
    """

    def __init__(self, data):
        self.fields = dict(zip(NAMES, HEADER.unpack(data[:128]), strict=True))
        self.header = {}
        h = self.fields
        at = h["header_size"]
        self.optional = data[128:at]
        self.metadata = data[at : at + h["metadata_length"]]
        at += h["metadata_length"]
        self.parameters = data[at : at + h["parameters_length"]]
        at += h["parameters_length"]
        self.grid = Grid(h["n_rows"], h["n_cols"], 2 ** h["block_log2"], h["border_rings"])
        body = at + h["top_page_length"]
        self.top = self._read(data, None, data[at:body], body)
        self.gap = b""  # between the first body and the others
        self.end = b""  # digests, or what is too much
        if h["features"] & 16:
            self.end = data[-8 - 32 * int.from_bytes(data[-4:], "little") :]
        self.change_header = lambda header: header

    def _read(self, data, head, its_page, at):
        segment = Segment(head, segment_layout(self.grid, head))
        keys, _, heads = segment.layout
        first_child, page = read_page(its_page, segment.layout)
        segment.columns = vars(page)
        pages = []
        for n_page in page.child_page_length:
            pages.append(data[at : at + n_page])
            at += n_page
        for key in file_order(keys):
            i = keys.index(key)
            for store, name in ((segment.payloads, "payload"), (segment.meshes, "mesh")):
                n = segment.columns[f"{name}_length"][i]
                store[key] = data[at : at + n]
                at += n
        at = first_child
        for child, of_child, n in zip(heads, pages, page.child_length, strict=True):
            segment.children.append(self._read(data, child, of_child, at) if n else None)
            at += n - len(of_child)
        return segment

    def json(self):
        """Return the metadata."""
        return json.loads(inflate(self.metadata, 2**20, DICTIONARY))

    def set_json(self, **changes):
        """Change keys of the metadata."""
        self.metadata = deflated(json.dumps(self.json() | changes).encode())

    def _columns(self, segment, lengths):
        keys = segment.layout[0]
        columns = {name: list(values) for name, values in segment.columns.items()}
        for name, store in (("payload", segment.payloads), ("mesh", segment.meshes)):
            columns[f"{name}_length"] = [len(store[key]) for key in keys]
            columns[f"{name}_crc"] = [zlib.crc32(store[key]) for key in keys]
        columns["child_page_length"] = [n_page for n_page, _ in lengths]
        columns["child_length"] = [n for _, n in lengths]
        segment.change_columns(columns)
        return columns

    def _write(self, segments):
        """Return (page but its head, sections) of segments of a level, and of the levels below."""
        below = [child for segment in segments for child in segment.children if child]
        written_below = self._write(below) if below else []
        at = iter(written_below[0] if below else [])
        level = []
        for segment in segments:
            lengths = []
            for child in segment.children:
                page, rest, n_below = next(at) if child else (b"", b"", 0)
                lengths.append((len(page), len(page) + n_below + len(rest)))
            columns = self._columns(segment, lengths)
            packed = segment.pack(
                b"".join(planes(columns[name], width) for name, width in COLUMNS.items())
            )
            rest = b"".join(
                store[key]
                for key in file_order(segment.layout[0])
                for store in (segment.payloads, segment.meshes)
            )
            level.append((bytes(12) + packed, rest, sum(n_page for n_page, _ in lengths)))
        return [level, *written_below]

    def bytes(self):
        """Return the file."""
        levels, segments = self._write([self.top]), [[self.top]]
        while below := [child for one in segments[-1] for child in one.children if child]:
            segments.append(below)
        page_length = len(levels[0][0][0])
        fields = dict(
            header_size=128 + len(self.optional),
            metadata_length=len(self.metadata),
            metadata_crc=zlib.crc32(self.metadata),
            parameters_length=len(self.parameters),
            parameters_crc=zlib.crc32(self.parameters),
            top_page_length=page_length,
        )
        before = self.optional + self.metadata + self.parameters
        start = 128 + len(before)
        at = start + page_length
        starts = []  # of bodies
        for number, level in enumerate(levels):
            at += len(self.gap) if number == 1 else 0
            for _, rest, n_below in level:
                starts.append(at)
                at += n_below + len(rest)
        n_done, pages = 0, []
        for level, row in zip(levels, segments, strict=True):
            child = n_done + len(level)
            for (page, *_), segment in zip(level, row, strict=True):
                first = 0
                if segment.layout[2]:
                    first = starts[child] if child < len(starts) else at
                    child += sum(one is not None for one in segment.children)
                if segment.first_child is not None:
                    first = segment.first_child(first)
                page = page[:4] + struct.pack("<Q", first) + page[12:]
                page = zlib.crc32(page[4:]).to_bytes(4, "little") + page[4:]
                pages.append(segment.change_page(page))
                n_done += 1
        rest_of_pages = iter(pages)
        body = bytearray(before + next(rest_of_pages))
        for number, (level, row) in enumerate(zip(levels, segments, strict=True)):
            body += self.gap if number == 1 else b""
            for (_, rest, _), segment in zip(level, row, strict=True):
                for child in segment.children:
                    body += next(rest_of_pages) if child else b""
                body += rest
        body += self.end
        fields["file_size"] = 128 + len(body)
        fields = self.fields | fields | self.header
        header = HEADER.pack(*(fields[name] for name in NAMES))[:124]
        header += zlib.crc32(header).to_bytes(4, "little")
        return self.change_header(header) + bytes(body)


def optional_section(name, content):
    """§4.8."""
    return name + struct.pack("<II", len(content), zlib.crc32(content)) + content


def varint(value):
    """§1.4."""
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
