"""The invalid files of the conformance set: what is wrong with each, and how it is made.

Written from docs/FORMAT.md. `tools/make_golden.py` writes those that are missing.
"""

import struct
import zlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from reference_decoder.mixing import RangeEncoder

from conformance import rapid
from conformance.editor import Editor, deflated, optional_section, varint
from terrainwave.reference.basics import read_varint
from terrainwave.reference.files import HEADER, METHODS, NAMES
from terrainwave.reference.range_coder import Models

MESHES = (
    "none", "halves", "zerotree-plain", "rqt", "zerotree-layer", "zerotree-coded",
    "rqt-coefficient",
)  # fmt: skip
ROOT = (-1, 0, 0)
# The raster of FORMAT.md §9.1.
HEIGHTS = np.array(
    [
        [302, 294, 290, 289, 284],
        [310, 303, 300, 296, -1],
        [324, 317, 308, 304, -1],
        [343, 335, 328, 321, 316],
        [-1, 356, 348, 337, 330],
    ],
    dtype=np.int16,
)
START = 9  # of the method's bytes in a payload of it: flags, length and bytes of the mask


@cache
def base(name):
    """Return the valid file that a case begins with."""
    from twz import twz_bytes  # compiles kernels

    options = dict(max_error=1, nodata=-1, mesh="none")
    options_0 = dict(max_error=0, method="store", mesh="none")
    row, col = np.mgrid[:34, :34]
    if name in METHODS.values():
        return twz_bytes(HEIGHTS, method=name, **options)
    if name == "exact":
        return twz_bytes(HEIGHTS / np.float32(3), max_error=0, method="rapid", mesh="none")
    if name == "levels":
        steps = (row // 9 + col // 12).astype(np.uint8)
        return twz_bytes(steps, max_error=0, method="store", mesh="none")
    if name == "groups":  # two on the finest level, which share a row
        return twz_bytes((np.arange(140).reshape(70, 2) % 7).astype(np.uint8), **options_0)
    if name == "flat":
        return twz_bytes(np.full((9, 9), 5, np.uint8), max_error=0, method="store", mesh="rqt")
    if name == "tiles":
        ramp = np.tile(np.arange(2100, dtype=np.int16) // 400, (2, 1))
        return twz_bytes(ramp, max_error=0, method="cdf53", mesh="none")
    if name == "rapid-far":  # heights that are not narrow, of a large step
        far = abs(HEIGHTS) * np.int32(10**6) + row[:5, :5].astype(np.int32)
        return twz_bytes(far, max_error=9000, method="rapid", mesh="none")
    if name == "rapid-row":  # a group of one strip
        return twz_bytes(
            (np.arange(66) % 7).astype(np.uint8)[None], **options_0 | {"method": "rapid"}
        )
    if name in ("zerotree-plain", "rqt"):
        rough = (row[:9, :9] * 9 + col[:9, :9]) * 37 % 23
        return twz_bytes(rough.astype(np.int16), max_error=0, method="store", mesh=name)
    return (Path(__file__).parents[1] / "golden" / "v2" / f"{name}.twz").read_bytes()


class Case(NamedTuple):
    """A file that must be rejected.

    `outcome` is "corrupt" or "unsupported" (§1.2). `found_by`: a reader of all "heights", of
    "mesh"es, or a "verifier". `change` makes the file of the base's bytes.
    """

    base: str
    clause: str
    fault: str
    change: object
    outcome: str = "corrupt"
    found_by: str = "heights"

    def bytes(self):
        """Return the file."""
        return self.change(base(self.base))


# Changes ---------------------------------------------------------------------------------------


def flip_byte(at):
    """Return a change of the lowest bit of one byte."""

    def change(data):
        data = bytearray(data)
        data[at] ^= 1
        return bytes(data)

    return change


def digests(data):
    """Put other digests at the end, with a checksum that matches."""
    tail = struct.pack("<II", zlib.crc32(data), len(data) // 32)
    return edited(lambda editor: setattr(editor, "end", data + tail))


def header(**fields):
    """Fields of the header, with a checksum that matches."""

    def change(data):
        editor = Editor(data)
        editor.header = fields
        return editor.bytes()

    return change


def edited(edit):
    """Whatever `edit` does to an `Editor`."""

    def change(data):
        editor = Editor(data)
        edit(editor)
        return editor.bytes()

    return change


def raw(text):
    """Metadata of this text, deflated."""
    return edited(lambda editor: setattr(editor, "metadata", deflated(text)))


def keys(**changes):
    """Metadata with other values."""
    return edited(lambda editor: editor.set_json(**changes))


def parameters(data):
    """Parameters of the method."""
    return edited(lambda editor: setattr(editor, "parameters", data))


def optional(*sections):
    """Optional sections of the header."""
    return edited(lambda editor: setattr(editor, "optional", b"".join(sections)))


def columns(change_columns):
    """The columns of the top page."""
    return edited(lambda editor: setattr(editor.top, "change_columns", change_columns))


def page(change_page):
    """The bytes of the top page, after its checksum is made."""
    return edited(lambda editor: setattr(editor.top, "change_page", change_page))


def payload(change, key=ROOT):
    """The payload of a key."""

    def edit(editor):
        editor.top.payloads[key] = change(editor.top.payloads[key])

    return edited(edit)


def mask(change, key=ROOT):
    """The mask section of a payload, which has one."""

    def change_payload(data):
        assert data[0] & 1
        n, start = read_varint(data, 1)
        section = change(data[start : start + n])
        return data[:1] + varint(len(section)) + section + data[start + n :]

    return payload(change_payload, key)


def corrections(change):
    """The corrections in the payload of the first unit that has some."""

    def edit(editor):
        payloads = editor.top.payloads
        key = min(key for key, data in payloads.items() if data and data[0] & 8)
        data, at = payloads[key], 1
        for bit in range(4):
            if data[0] >> bit & 1:
                n, start = read_varint(data, at)
                begin, at = at, start + n
        section = change(data[start:at])
        payloads[key] = data[:begin] + varint(len(section)) + section + data[at:]

    return edited(edit)


def coded_corrections(value):
    """A section of `PATCHED`'s root, 20 rows of one piece of 19: its first sample has a value."""
    encoder, models = RangeEncoder(), Models(170)
    has_any = int(value != 0)
    encoder.bit(models, 0, has_any)
    for col in range(19 if has_any else 0):
        west = int(col in (1, 2))
        encoder.bit(models, 16 + 27 * (col % 2) + 9 * west, int(col == 0))
        if col == 0:
            encoder.raw(0, 1)
            for i in range(14):
                encoder.bit(models, 124 + i, 1)
            low = 10  # of step 18001
            rest = value - 1 - (13 << low)
            n_bits = rest.bit_length() - 1
            for i in range(n_bits - low + 1):
                encoder.bit(models, 138 + i, int(i < n_bits - low))
            encoder.raw(rest, n_bits)
    for row in range(1, 20):
        above, above_2 = has_any * (row == 1), has_any * (row == 2)
        encoder.bit(models, 8 * (row % 2) + 2 * above + above_2, 0)
    return encoder.end()


def method_bytes(change, key=ROOT):
    """The bytes of the method in a payload, the root's unless told."""

    def change_payload(data):
        own = rapid.own_bytes(data)
        return data[: len(data) - len(own)] + change(own)

    return payload(change_payload, key)


def of_rapid(edit, key=ROOT):
    """Whatever `edit` does to the bytes of rapid in a payload, taken apart."""

    def change(data):
        found = rapid.Payload(data)
        edit(found)
        return found.bytes()

    return method_bytes(change, key)


def band(part, change):
    """Other bytes of a part of the only band: 0 its states, 1 its words, 2 its raw bits."""

    def edit(found):
        found.bands[0][part] = bytearray(change(bytes(found.bands[0][part])))
        if part:
            found.sizes[0][part - 1] = len(found.bands[0][part]) // (3 - part)

    return of_rapid(edit)


def tables(edit, family=0):
    """A parameters section of rapid; `edit` changes what is written there."""
    return parameters(rapid.section(edit, family))


def weight(code):
    """One code of what the trained ones of rapid become."""
    return tables(lambda found: found.weights[1].__setitem__(3, code))


def frequency(symbol, code, table=0):
    """One code of the frequencies of a table of rapid."""

    def edit(found):
        found.frequencies[table] = found.trained(table)
        found.frequencies[table][symbol] = code

    return tables(edit)


def stencil(changes, shift=0):
    """Changes of the trained stencil of HL of the finest tier."""
    return tables(lambda found: found.stencils.__setitem__(1, (0, shift, changes)))


def own_stream(change):
    """The stream of a parameters section of rapid that is as long as any."""
    data = rapid.section(lambda found: found.stencils.__setitem__(0, (1, 0, None)))
    return parameters(data[:1] + change(data[1:]))


def mesh(data):
    """The mesh section of the root."""
    return edited(lambda editor: editor.top.meshes.__setitem__(ROOT, data))


def put(at, *values):
    """Other bytes at a place."""
    return lambda data: data[:at] + bytes(values) + data[at + len(values) :]


def flip(at, mask=1):
    """Other bits of one byte."""
    return lambda data: data[:at] + bytes([data[at] ^ mask]) + data[at + 1 :]


def column(name, value, row=0):
    """One number of the top page."""
    return columns(lambda found: found[name].__setitem__(row, value))


def of_a_child(name, change):
    """One number of the top page, of the first child that is present."""

    def change_columns(found):
        row = next(i for i, length in enumerate(found["child_length"]) if length)
        found[name][row] = change(found[name][row])

    return columns(change_columns)


def lower(data):
    """Return a payload of store, without mask, whose lowest height is one less."""
    (low,) = struct.unpack_from("<i", data, 1)
    return data[:1] + struct.pack("<i", low - 1) + data[5:]


def no_flags(n=8):
    """Return a stream that says of no border sample of a flat block of n cells that it is one."""
    encoder, models = RangeEncoder(), Models(39)
    for _ in range(4):
        spacing = n // 2
        while spacing:
            for q in range(spacing, n, 2 * spacing):
                ends = (q - spacing == 0) + (min(q + spacing, n) == n)
                encoder.bit(models, 3 * (spacing.bit_length() - 1) + ends, 0)
            spacing //= 2
    return encoder.end()


def crc_53(data):
    """Return a payload of cdf53 without stream whose head's checksum is mended."""
    return data + zlib.crc32(data).to_bytes(4, "little")


def head_53(*numbers, flags=0, masks=b"", borders=b"\0"):
    """Return a payload of cdf53: low, n_planes, ends, n_stream."""
    return crc_53(bytes([flags]) + masks + borders + b"".join(map(varint, numbers)))


def remainders(section):
    """Replace the section of remainders of a payload without mask and exceptions."""

    def change(data):
        assert data[0] == 4
        n = data[1]
        assert n < 128
        return bytes([4]) + varint(len(section)) + section + data[2 + n :]

    return payload(change)


def planes_of_zeros(n_planes, n_samples=25):
    return zlib.compress(bytes(n_planes * n_samples), 9)


# Remainders of 0x3d400000 each: from floats of some hundred to beyond the largest.
HUGE = zlib.compress(bytes(2 * 25) + b"\x80" * 25 + b"\x7a" * 25, 9)
PATCHED = "rapid-patched-int32-wide"
LONE = b'{"software":"\\ud800"}'
NESTED = b'{"x":' + b"[" * 16 + b"]" * 16 + b"}"
BOMB = b'{"x":"' + b"0" * 2**20 + b'"}'

CASES = {
    # The file and its header
    "empty": Case("store", "§3.5", "no byte at all", lambda data: b""),
    "cut-in-header": Case("store", "§3.5", "100 bytes", lambda data: data[:100]),
    "magic-of-text-mode": Case(
        "store", "§4.1", "the magic's line ends changed, as by a copy in text mode",
        lambda data: data[:4] + b"\n\x1a\n" + data[7:],
    ),
    "version-3": Case("store", "§4.1", "version 3", header(version=3), "unsupported"),
    "version-1": Case(
        "store", "§4.1", "version 1, of development builds", header(version=1), "unsupported"
    ),
    "version-0": Case("store", "§4.1", "version 0", header(version=0), "unsupported"),
    "header-crc": Case("store", "§4.1", "header_crc", flip(125)),
    "header-size": Case("store", "§4.1", "header_size 127", header(header_size=127)),
    "optional-cut": Case("store", "§4.8", "a section of 11 bytes", optional(bytes(11))),
    "optional-beyond": Case(
        "store", "§4.8", "a section that ends a byte after the header",
        optional(optional_section(b"none", b"content")[:-1]),
    ),
    "optional-twice": Case(
        "store", "§4.8", "two sections of one name", optional(
            optional_section(b"none", b"one"), optional_section(b"none", b"other")
        ),
    ),
    "optional-crc": Case(
        "store", "§4.8", "crc of a section",
        optional(optional_section(b"none", b"content")[:-1] + b"x"),
    ),
    "reserved-byte": Case("store", "§1.2", "reserved byte 1", header(reserved=1), "unsupported"),
    "padding": Case("store", "§1.2", "padding 0, 1", header(padding=b"\0\1"), "unsupported"),
    "feature-5": Case("store", "§4.7", "feature bit 5", header(features=33), "unsupported"),
    "feature-31": Case(
        "store", "§4.7", "feature bit 31", header(features=2**31 + 1), "unsupported"
    ),
    "all-void-not-told": Case(
        "all-void", "§4.1", "no valid sample without feature bit 0", header(features=0)
    ),
    "remainders-int16": Case("store", "§4.1", "remainders of int16", header(features=3)),
    "remainders-step": Case("exact", "§4.1", "remainders beside step 3", header(step=3)),
    "remainders-bound": Case(
        "exact", "§4.1", "remainders beside an effective_bound",
        header(max_error=1.0, effective_bound=0.5),
    ),
    "faithful-store": Case("store", "§4.1", "a faithful file of store", header(features=5)),
    "file-cut": Case("store", "§3.5", "the last byte is missing", lambda data: data[:-1]),
    "file-longer": Case("store", "§1.5", "a byte after the last one", lambda data: data + b"\0"),
    "byte-left-over": Case(
        "store", "§1.5", "a byte after the last section, within file_size",
        edited(lambda editor: setattr(editor, "end", b"\0")),
    ),
    "digests-crc": Case(
        "store-digests-int16", "§4.9", "checksum of the digests", flip_byte(-8),
        found_by="verifier",
    ),
    "digests-short": Case(
        "store-digests-int16", "§4.9", "begin 32 bytes behind the segments",
        edited(lambda editor: setattr(editor, "end", bytes(32) + editor.end)),
        found_by="verifier",
    ),
    "digests-none": Case(
        "store-digests-int16", "§4.9", "no digest", digests(b""), found_by="verifier"
    ),
    "digests-cut": Case(
        "store-digests-int16", "§4.9", "a section of 36 bytes",
        edited(lambda editor: setattr(editor, "end", editor.end[-36:])),
    ),
    "rows-0": Case("store", "§4.1", "no rows", header(n_rows=0)),
    "rows-too-many": Case("store", "§4.1", "2^31 + 1 rows", header(n_rows=2**31 + 1)),
    "samples-too-many": Case(
        "store", "§4.1", "2^30 rows of 2^21 samples", header(n_rows=2**30, n_cols=2**21)
    ),
    "block-16": Case("store", "§4.1", "block_log2 4", header(block_log2=4)),
    "block-2048": Case("store", "§4.1", "block_log2 11", header(block_log2=11)),
    "border-rings-2": Case("store", "§4.1", "border_rings 2", header(border_rings=2)),
    "method-5": Case("store", "§4.1", "method 5", header(method=5), "unsupported"),
    "dtype-2": Case("store", "§4.1", "dtype 2", header(dtype=2), "unsupported"),
    "effort-10": Case("store", "§4.1", "effort 10", header(effort=10), "unsupported"),
    "mesh-7": Case("store", "§4.1", "mesh 7", header(mesh=7), "unsupported"),
    "mesh-6-of-store": Case(
        "store", "§4.1", "meshes by coefficients in a file of store", header(mesh=6)
    ),
    "mesh-tolerance": Case(
        "store", "§4.1", "a mesh_tolerance without meshes", header(mesh_tolerance=16)
    ),
    "quantum-0": Case("store", "§4.1", "quantum_num 0", header(quantum_num=0)),
    "quantum-2-4": Case(
        "store", "§4.1", "a quantum of 2/4", header(quantum_num=2, quantum_den=4)
    ),
    "quantum-2-63": Case("store", "§4.1", "quantum_den 2^63", header(quantum_den=2**63)),
    "base-too-large": Case(
        "store", "§4.1", "(abs(base) + 2^31) · quantum_num = 2^63", header(base=2**63 - 2**31)
    ),
    "step-even": Case("store", "§4.1", "step 2", header(step=2)),
    "step-too-large": Case("store", "§4.1", "step 2^31 + 1", header(step=2**31 + 1)),
    "range-too-large": Case(
        "store", "§4.1", "z_max − z_min = 2^30", header(z_min=-(2**29), z_max=2**29)
    ),
    "range-wraps": Case(
        "store", "§4.1", "z_max − z_min = 2^31", header(z_min=-(2**30), z_max=2**30)
    ),
    "range-empty": Case("store", "§4.1", "z_min 2, z_max 1", header(z_min=2, z_max=1)),
    "max-error-nan": Case("store", "§4.1", "max_error NaN", header(max_error=float("nan"))),
    "bound-above-max-error": Case(
        "store", "§4.1", "effective_bound above max_error", header(effective_bound=1.5)
    ),
    "rho-negative": Case("store", "§4.1", "rho −1", header(rho=-1.0)),
    "rho-above-max-error": Case("store", "§4.1", "rho above max_error", header(rho=1.5)),
    "metadata-length-0": Case("store", "§4.1", "metadata_length 0", header(metadata_length=0)),
    "sections-beyond-file": Case(
        "store", "§4.1", "metadata_length beyond the file", header(metadata_length=2**20)
    ),
    "parameters-too-long": Case(
        "store", "§4.1", "parameters_length 2^16 + 1", header(parameters_length=2**16 + 1)
    ),
    "cdf53-rings-3": Case("cdf53", "C.1", "border_rings 3", header(border_rings=3)),
    # Metadata
    "metadata-crc": Case("store", "§4.1", "metadata_crc", header(metadata_crc=0)),
    "metadata-cut": Case(
        "store", "§1.3", "a deflated section that ends early",
        edited(lambda editor: setattr(editor, "metadata", editor.metadata[:-3])),
    ),
    "metadata-left-over": Case(
        "store", "§1.3", "a byte after a deflated section",
        edited(lambda editor: setattr(editor, "metadata", editor.metadata + b"\0")),
    ),
    "metadata-bomb": Case("store", "§4.2", "inflates to more than 2^20 bytes", raw(BOMB)),
    "metadata-array": Case("store", "§4.2", "no JSON object", raw(b"[1]")),
    "metadata-utf8": Case("store", "§4.2", "no UTF-8", raw(b'{"units":"\xff"}')),
    "metadata-bom": Case("store", "§4.2", "a byte order mark", raw(b"\xef\xbb\xbf{}")),
    "metadata-key-twice": Case("store", "§4.2", "a key twice", raw(b'{"x":1,"x":1}')),
    "metadata-nan": Case("store", "§4.2", "NaN", raw(b'{"x":NaN}')),
    "metadata-infinite": Case("store", "§4.2", "1e999", raw(b'{"x":1e999}')),
    "metadata-integer": Case(
        "store", "§4.2", "10^400 in digits", raw(b'{"x":1' + b"0" * 400 + b"}")
    ),
    "metadata-surrogate": Case("store", "§4.2", "an escaped lone surrogate", raw(LONE)),
    "metadata-nested": Case("store", "§4.2", "brackets 17 deep", raw(NESTED)),
    "metadata-crs": Case("store", "§4.2", "crs is a number", keys(crs=4326)),
    "metadata-transform": Case("store", "§4.2", "five numbers", keys(transform=[1, 0, 0, 0, 1])),
    "metadata-scale-0": Case("store", "§4.2", "scale 0", keys(scale=0)),
    "metadata-offset": Case(
        "store", "§4.2", "offset is an integer beyond 2^64", keys(offset=2**64 + 1)
    ),
    "metadata-nodata-fraction": Case(
        "store", "§4.2", "nodata −0.5 of an integer dtype", keys(nodata=-0.5)
    ),
    "metadata-nodata-range": Case("store", "§4.2", "nodata 32768 of int16", keys(nodata=32768)),
    "metadata-nodata-nan": Case("store", "§4.2", "nodata NaN of int16", keys(nodata="nan")),
    "metadata-nodata-float32": Case(
        "exact", "§4.2", "nodata 1e39 of float32", keys(nodata=1e39)
    ),
    "metadata-mask-kind": Case("store", "§4.2", 'mask_kind "alpha"', keys(mask_kind="alpha")),
    "metadata-area": Case(
        "store", "§4.2", 'area_or_point "area"', keys(area_or_point="area")
    ),
    "metadata-tags": Case("store", "§4.2", "a tag that is a number", keys(tags={"x": 1})),
    "metadata-moved": Case("store", "§4.2", "moved −1", keys(moved=-1)),
    # Parameters
    "parameters-crc": Case("rapid", "§4.1", "parameters_crc", header(parameters_crc=1)),
    "parameters-of-store": Case(
        "store", "§4.3", "parameters of a method that has none", parameters(b"\1"), "unsupported"
    ),
    "parameters-predictive-layout": Case(
        "predictive", "P.10", "layout 2", parameters(b"\2\0\0\0\0"), "unsupported"
    ),
    "parameters-predictive-cut": Case(
        "predictive", "P.10", "a stream that ends early", parameters(b"\1\0")
    ),
    "parameters-predictive-sets": Case(
        "predictive", "P.10", "15 stencils beside those of the annex",
        parameters(b"\1" + b"\xf0" + bytes(60)),
    ),
    "parameters-rapid-family-6": Case("rapid", "R.10", "family 6", parameters(b"\xc0")),
    "parameters-rapid-family-7": Case(
        "rapid", "R.10", "family 7 before a stream",
        parameters(b"\xe0" + rapid.Section().bytes()[1:]),
    ),
    "parameters-rapid-left-over": Case(
        "rapid", "R.10", "a byte after the stream", own_stream(lambda data: data + b"\0")
    ),
    "parameters-rapid-short": Case(
        "rapid", "R.10", "a stream a byte short", own_stream(lambda data: data[:-1])
    ),
    "parameters-rapid-change": Case(
        "rapid", "R.10", "a weight of a stencil that changes by 65535", stencil({0: 65535})
    ),
    "parameters-rapid-change-wraps": Case(
        "rapid", "R.10", "a weight of a stencil that changes by 2^32", stencil({0: 2**32})
    ),
    "parameters-rapid-stencil": Case(
        "rapid", "R.10", "a weight of 32768 at least", stencil({0: 300, 2: -300}, shift=7)
    ),
    "parameters-rapid-missing-tap": Case(
        "rapid", "R.10", "a weight beyond 32767 of the missing tap",
        stencil({0: -20000, 2: -20000}),
    ),
    "parameters-rapid-sum": Case(
        "rapid", "R.10", "absolute weights of more than 2^18 in all",
        stencil({tap: 15000 * (-1) ** tap for tap in range(20) if tap != 5}),
    ),
    "parameters-rapid-code-negative": Case(
        "rapid", "R.10", "a code of a weight below 0", weight(-1)
    ),
    "parameters-rapid-code-256": Case(
        "rapid", "R.10", "a code of a weight of 256", weight(256)
    ),
    "parameters-rapid-code-wraps": Case(
        "rapid", "R.10", "a code that changes by 2^32", frequency(0, 2**32)
    ),
    "parameters-rapid-cut": Case(
        "rapid", "R.10", "cut 61", tables(lambda found: setattr(found, "cut", 61))
    ),
    "parameters-rapid-frequency-negative": Case(
        "rapid", "R.10", "a code of a frequency below 0", frequency(32, -1, table=100)
    ),
    "parameters-rapid-no-rest-pair": Case(
        "rapid", "R.10", "frequencies that leave nothing to pairs of no detail",
        frequency(113, 144),
    ),
    "parameters-rapid-no-rest-sample": Case(
        "rapid", "R.10", "frequencies that leave nothing to samples of escaped pairs",
        frequency(0, 200, table=120),
    ),
    # Index pages
    "page-crc": Case("store", "§3.3", "crc of a page", page(flip(0))),
    "page-left-over": Case(
        "store", "§1.3", "a byte after the columns",
        edited(lambda editor: setattr(
            editor.top, "pack", lambda data: zlib.compress(data, 9) + b"\0"
        )),
    ),
    "page-columns-short": Case(
        "store", "§3.3", "columns of a byte less",
        edited(lambda editor: setattr(editor.top, "pack", lambda data: zlib.compress(data[:-1]))),
    ),
    "page-columns-long": Case(
        "store", "§3.3", "columns that inflate to more than their size",
        edited(lambda editor: setattr(
            editor.top, "pack", lambda data: zlib.compress(data + bytes(10**6), 9)
        )),
    ),
    "page-flags": Case("store", "§3.3", "a key's flags 1", column("flags", 1), "unsupported"),
    "page-payload-length": Case(
        "store", "§3.3", "a payload of 2^31 bytes", column("payload_length", 2**31)
    ),
    "page-payload-beyond": Case(
        "store", "§3.3", "a payload that ends beyond the file",
        columns(lambda found: found["payload_length"].__setitem__(
            0, found["payload_length"][0] + 1
        )),
    ),
    "page-empty-crc": Case(
        "store", "§3.3", "an empty mesh section with a checksum", column("mesh_crc", 1)
    ),
    "page-first-child": Case(
        "store", "§3.3", "first_child 200 where there are no children",
        edited(lambda editor: setattr(editor.top, "first_child", lambda first: 200)),
    ),
    "page-child-before": Case(
        "store-int16-segments", "§3.5", "first_child a byte too early",
        edited(lambda editor: setattr(editor.top, "first_child", lambda first: first - 1)),
    ),
    "page-child-length": Case(
        "store-int16-segments", "§3.3", "a child_length a byte too long",
        of_a_child("child_length", lambda length: length + 1),
    ),
    "page-child-without-page": Case(
        "store-int16-segments", "§3.3", "a present child without page",
        of_a_child("child_page_length", lambda length: 0),
    ),
    "page-child-page-12": Case(
        "store-int16-segments", "§3.3", "a child's page of 12 bytes",
        of_a_child("child_page_length", lambda length: 12),
    ),
    "segment-gap": Case(
        "store-int16-segments", "§1.5", "a byte between two segments",
        edited(lambda editor: setattr(editor, "gap", b"\0")),
    ),
    # Payloads
    "payload-crc": Case("store", "§3.3", "payload_crc", column("payload_crc", 1)),
    "payload-flags": Case("store", "§5.1", "flag bit 4", payload(flip(0, 16))),
    "payload-mask-unasked": Case(
        "store", "§5.1", "a mask section without feature bit 0", header(features=0)
    ),
    "payload-empty-unasked": Case(
        "groups", "§5.1", "an empty payload without feature bit 0",
        payload(lambda data: b"", key=(1, 0, 0)),
    ),
    "payload-remainders": Case(
        "store", "§5.1", "flag of remainders without feature bit 1", payload(flip(0, 4))
    ),
    "payload-remainders-coarse": Case(
        "predictive-float64-exact", "§5.1", "flag of remainders on level 0", payload(flip(0, 4))
    ),
    "varint-long": Case(
        "store", "§1.4", "a varint that could be shorter",
        payload(lambda data: data[:1] + b"\x87\0" + data[2:]),
    ),
    "varint-six-bytes": Case(
        "store", "§1.4", "a varint of six bytes",
        payload(lambda data: data[:1] + b"\x87\x80\x80\x80\x80\x01" + data[2:]),
    ),
    "mask-empty": Case(
        "store", "§5.1", "a mask section of length 0", mask(lambda section: b""),
    ),
    "mask-cut": Case(
        "store", "§5.2", "a mask without its last word", mask(lambda section: section[:-2]),
    ),
    "mask-half-a-word": Case(
        "store", "§5.2", "a mask of one byte too few", mask(lambda section: section[:-1]),
    ),
    "mask-without-state": Case(
        "store", "§5.2", "a mask that ends within its state", mask(lambda section: section[:3]),
    ),
    "mask-state": Case(
        "store", "§5.2", "a mask whose state does not become 2^16", mask(flip(1)),
    ),
    "mask-left-over": Case(
        "store", "§5.2", "a mask with a word too much", mask(lambda section: section + b"\0\0"),
    ),
    "mask-sets": Case(
        "store", "§5.2", "a mask with frequencies of its own and a set of samples",
        mask(lambda section: b"\x71" + bytes(62) + section[1:]),
    ),
    "mask-beyond": Case(
        "store", "§5.1", "a mask section longer than the payload", payload(put(1, 99))
    ),
    "mask-of-a-coarse-level-left-over": Case(
        "store-int16-segments", "§5.2", "a mask of level 0 with a word too much",
        mask(lambda section: section + b"\0\0"),
    ),
    "mask-of-a-group-left-over": Case(
        "store-int16-segments", "§5.2", "a mask of a group with a word too much",
        mask(lambda section: section + b"\0\0", key=(0, 0, 0)),
    ),
    "corrections-of-step-1": Case(
        "predictive-int16-lossless", "§4.7", "feature bit 3 with step 1", header(features=8),
        "unsupported",
    ),
    "corrections-unasked": Case(
        "rapid", "§5.1", "a flag of corrections without feature bit 3",
        payload(lambda data: bytes([data[0] | 8]) + data[1:]),
    ),
    "corrections-empty": Case(
        PATCHED, "§5.1", "a section of corrections of length 0", corrections(lambda section: b""),
    ),
    "corrections-cut": Case(
        PATCHED, "§6.2", "corrections whose stream is a byte short",
        corrections(lambda section: section[:-1]),
    ),
    "corrections-left-over": Case(
        PATCHED, "§6.2", "corrections whose stream has a byte too much",
        corrections(lambda section: section + b"\0"),
    ),
    "corrections-all-0": Case(
        PATCHED, "§5.4", "a section in which all corrections are 0",
        corrections(lambda section: coded_corrections(0)),
    ),
    "corrections-too-large": Case(
        PATCHED, "§5.4", "a correction of 2^31",
        corrections(lambda section: coded_corrections(2**31)),
    ),
    "exceptions-unasked": Case(
        "store", "§5.1", "exceptions where no sample has any",
        payload(lambda data: b"\3" + data[1:START] + b"\1\0" + data[START:]),
    ),
    "store-short": Case("store", "§8", "a byte short", payload(lambda data: data[:-1])),
    "store-long": Case("store", "§8", "a byte too many", payload(lambda data: data + b"\0")),
    "store-32-bits": Case(
        "store", "§8", "32 bits per sample",
        payload(lambda data: data[: START + 4] + b"\x20" + bytes(4 * 22)),
    ),
    "predictive-flags": Case("predictive", "P.1", "flag bit 2", method_bytes(flip(0, 4))),
    "predictive-empty": Case(
        "predictive", "P.1", "no byte of the method", method_bytes(lambda data: b"")
    ),
    "predictive-cut": Case(
        "predictive", "P.1", "a stream a byte short", method_bytes(lambda data: data[:-1])
    ),
    "predictive-left-over": Case(
        "predictive", "P.1", "a byte after the stream", method_bytes(lambda data: data + b"\0")
    ),
    "rapid-rings-3": Case("rapid", "R.2", "border_rings 3", header(border_rings=3)),
    "rapid-empty": Case("rapid", "R.1", "no byte of the method", method_bytes(lambda data: b"")),
    "rapid-flags-64": Case("rapid", "R.1", "flag 64", method_bytes(flip(0, 64))),
    "rapid-flags-128": Case("rapid", "R.1", "flag 128", method_bytes(flip(0, 128))),
    "rapid-states-3": Case(
        "rapid", "R.1", "number 3 of states", of_rapid(lambda found: found.set_flags(6))
    ),
    "rapid-shift-31": Case(
        "rapid", "R.1", "a shift of 31 bits", of_rapid(lambda found: found.set_wide(31))
    ),
    "rapid-narrow-large-step": Case(
        "rapid-far", "R.1", "a narrow unit of step 18001",
        of_rapid(lambda found: found.set_narrow()),
    ),
    "rapid-origin-above": Case(
        "rapid", "R.2", "an origin above z_max", of_rapid(lambda found: found.set_origin(1))
    ),
    "rapid-origin-below": Case(
        "rapid", "R.2", "an origin below z_min", of_rapid(lambda found: found.set_origin(-1))
    ),
    "rapid-origin-wraps": Case(
        "rapid", "R.2", "an origin 2^64 from the middle",
        of_rapid(lambda found: (found.set_wide(30), found.set_origin(2**24))),
    ),
    "rapid-two-bands": Case(
        "rapid", "R.1", "two bands of a root block", of_rapid(lambda found: found.add_bands(1))
    ),
    "rapid-band-state": Case(
        "rapid-row", "R.1", "a state of 65537 of a band without strips",
        of_rapid(lambda found: found.add_bands(1, state=65537), key=(0, 0, 0)),
    ),
    "rapid-words-beyond": Case(
        "rapid", "R.1", "more words than there are", of_rapid(lambda found: found.claim(0, 1))
    ),
    "rapid-words-wrap": Case(
        "rapid", "R.1", "2^31 words more than there are",
        of_rapid(lambda found: found.claim(0, 2**31)),
    ),
    "rapid-bits-beyond": Case(
        "rapid", "R.1", "more bytes of raw bits than there are",
        of_rapid(lambda found: found.claim(1, 1)),
    ),
    "rapid-byte-left-over": Case(
        "rapid", "R.1", "a byte after the bands", method_bytes(lambda data: data + b"\0")
    ),
    "rapid-word-left-over": Case(
        "rapid", "R.1", "a word that is not read", band(1, lambda words: words + b"\0\0")
    ),
    "rapid-word-missing": Case("rapid", "R.1", "a word too few", band(1, lambda words: words[:-2])),
    "rapid-state-small": Case(
        "rapid", "R.1", "a state of 65535", band(0, lambda states: b"\xff\xff\0\0" + states[4:])
    ),
    "rapid-state": Case(
        "rapid", "R.1", "a state that ends as 65537",
        edited(lambda editor: rapid.draw_payloads(editor, 1, last_state=65537)),
    ),
    "rapid-bits-left-over": Case(
        "rapid", "R.1", "a byte of raw bits too many", band(2, lambda raw: raw + b"\0")
    ),
    "rapid-bits-missing": Case(
        "rapid", "R.1", "a byte of raw bits too few", band(2, lambda raw: raw[:-1])
    ),
    "rapid-bits-filling": Case(
        "rapid", "R.1", "a 1 above the last raw bit",
        band(2, lambda raw: raw[:-1] + bytes([raw[-1] | 128])),
    ),
    "cdf97-flags": Case("cdf97", "§7.1", "flag 8", method_bytes(put(0, 8))),
    "cdf97-raw-and-coefficients": Case(
        "cdf97", "§7.1", "flags raw and coefficients", method_bytes(put(0, 5))
    ),
    "cdf97-raw-width": Case(
        "cdf97", "§7.1", "33 raw bits", method_bytes(lambda data: b"\4\x21" + data[2:])
    ),
    "cdf97-raw-base": Case(
        "cdf97", "§7.1", "a base of 2^30 + 1",
        method_bytes(lambda data: data[:2] + varint(2**31 + 2) + data[3:]),
    ),
    "cdf97-step-0": Case(
        "cdf97", "§7.1", "step code 0", method_bytes(lambda data: b"\1\0\0" + bytes(1))
    ),
    "cdf97-offset": Case(
        "cdf97", "§7.1", "64 in the byte of offset and along",
        method_bytes(lambda data: b"\1\x80\1\x40" + bytes(1)),
    ),
    "cdf97-weights": Case(
        "cdf97", "§7.1", "a set of weights that does not exist",
        method_bytes(lambda data: b"\2\xff" + bytes(1)),
    ),
    "cdf97-left-over": Case(
        "cdf97", "§6.2", "a byte after the stream", method_bytes(lambda data: data + b"\0")
    ),
    "cdf53-flags": Case("cdf53", "C.4", "flag 2", payload(lambda data: head_53(0, 0, 0, flags=2))),
    "cdf53-masks-unasked": Case(
        "cdf53", "C.4", "masks without feature bit 0", header(features=0)
    ),
    "cdf53-empty-unasked": Case(
        "tiles", "C.4", "an empty payload without feature bit 0",
        edited(lambda editor: editor.top.payloads.__setitem__(head_of_a_tile(editor), b"")),
    ),
    "cdf53-head-crc": Case("cdf53", "C.4", "crc of a head", payload(
        lambda data: head_53(0, 0, 0)[:-1] + bytes([head_53(0, 0, 0)[-1] ^ 1])
    )),
    "cdf53-planes": Case("cdf53", "C.4", "61 planes", payload(
        lambda data: head_53(0, 61, *[0] * 61, 0)
    )),
    "cdf53-low": Case("cdf53", "C.4", "low −2^31", payload(
        lambda data: head_53(2**32 - 1, 0, 0)
    )),
    "cdf53-borders": Case("cdf53", "C.4", "borders where no side is held", payload(
        lambda data: head_53(0, 0, 0, borders=b"\1\0")
    )),
    "cdf53-stream-unasked": Case("cdf53", "C.4", "bytes of a stream of no planes", payload(
        lambda data: head_53(0, 0, 1) + b"\0" + zlib.crc32(b"\0").to_bytes(4, "little")
    )),
    "cdf53-stream-long": Case("cdf53", "C.4", "n_stream above the sum of the ends", payload(
        lambda data: head_53(0, 1, 1, 2) + b"\0\0" + zlib.crc32(b"\0\0").to_bytes(4, "little")
    )),
    "cdf53-piece-crc": Case("cdf53", "C.4", "crc of a piece of the stream", payload(
        lambda data: data[:-1] + bytes([data[-1] ^ 1])
    )),
    "cdf53-low-of-a-tile": Case(
        "tiles", "C.4", "low of a tile that is not the root one",
        edited(lambda editor: tile_low(editor)),
    ),
    "cdf53-between-tiles": Case(
        "tiles", "C.1", "a payload at a key that heads no tile",
        payload(lambda data: head_53(0, 0, 0), key=(0, 0, 0)),
    ),
    "remainders-0-bytes": Case("exact", "§5.3", "n = 0", remainders(
        b"\0" + planes_of_zeros(0)
    )),
    "remainders-5-bytes": Case("exact", "§5.3", "n = 5 of float32", remainders(
        b"\5" + planes_of_zeros(5)
    )),
    "remainders-short": Case("exact", "§5.3", "a byte of one sample missing", remainders(
        b"\1" + planes_of_zeros(1, 24)
    )),
    "remainders-long": Case("exact", "§5.3", "inflates to more", remainders(
        b"\1" + planes_of_zeros(1, 10**5)
    )),
    "remainders-infinite": Case("exact", "§5.3", "a float that is not finite", remainders(
        b"\4" + HUGE
    )),
    # Mesh sections
    "mesh-crc": Case(
        "zerotree-plain", "§3.3", "mesh_crc", column("mesh_crc", 1), found_by="mesh"
    ),
    "mesh-part-beyond": Case(
        "zerotree-plain", "§4.5", "a part longer than its section", mesh(b"\5\0\0"),
        found_by="mesh",
    ),
    "mesh-left-over": Case(
        "zerotree-plain", "§4.5", "a byte after the last part",
        edited(lambda editor: editor.top.meshes.__setitem__(
            ROOT, editor.top.meshes[ROOT] + b"\0"
        )), found_by="mesh",
    ),
    "mesh-empty-parts": Case(
        "rqt", "§4.5", "a section of empty parts that is not empty", mesh(b"\0"), found_by="mesh"
    ),
    "mesh-contexts-2": Case(
        "zerotree-plain", "format-mesh-zerotree §3", "contexts 2", mesh(b"\2\2\0"),
        found_by="mesh",
    ),
    "mesh-labels-left-over": Case(
        "zerotree-plain", "format-mesh-zerotree §3", "bytes after the labels",
        edited(lambda editor: editor.top.meshes.__setitem__(
            ROOT, longer_part(editor.top.meshes[ROOT])
        )), found_by="mesh",
    ),
    "mesh-no-flag": Case(
        "flat", "format-mesh-rqt §3", "a stream that sets no flag",
        mesh(varint(len(no_flags())) + no_flags()), found_by="mesh",
    ),
    "mesh-flags-left-over": Case(
        "rqt", "format-mesh-rqt §3", "bytes after the flags", mesh(b"\x04\x3e\x30\0\0"),
        found_by="mesh",
    ),
    # What a verifier finds
    "neighbours-differ": Case(
        "groups", "§2.4", "two groups differ in samples they share",
        payload(lower, key=(1, 0, 0)), found_by="verifier",
    ),
}  # fmt: skip


def head_of_a_tile(editor):
    """Return the key of a tile that is not the root one."""
    return next(key for key in editor.top.payloads if key != ROOT and editor.top.payloads[key])


def tile_low(editor):
    """Give a tile of a file of cdf53 that is not the root one a `low`."""
    key = head_of_a_tile(editor)
    data = editor.top.payloads[key]
    borders = varint(data[1]) + data[2 : 2 + data[1]]
    assert data[0] == 0
    assert data[2 + data[1]] == 0
    editor.top.payloads[key] = head_53(2, 0, 0, borders=borders)


def longer_part(section):
    """Return a section of one part, with a byte more in it."""
    assert len(section) == section[0] + 1 < 128
    return bytes([section[0] + 1]) + section[1:] + b"\0"


def entry(name, data):
    """Return what the manifest says of an invalid file, but for its digest."""
    case = CASES[name.removesuffix(".twz")]
    found = {"clause": case.clause, "fault": case.fault, "outcome": case.outcome}
    found["found_by"] = case.found_by
    fields = HEADER.unpack(data[:128]) if len(data) >= 128 else None
    fields = dict(zip(NAMES, fields, strict=True)) if fields else {}
    method, mesh_code = fields.get("method"), fields.get("mesh", 0)
    return found | {
        "method": METHODS.get(method, "store" if method is None else "unknown"),
        "features": fields.get("features", 0),
        "mesh": MESHES[mesh_code] if mesh_code < len(MESHES) else "unknown",
    }
