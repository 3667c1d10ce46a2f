"""The fixed header at the start of a file: fields, limits, bytes (FORMAT.md §4.1)."""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from fractions import Fraction
from functools import cached_property
from typing import Any, cast

import numpy as np

from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    TerrainwaveError,
    TruncatedStreamError,
    UnsupportedVersionError,
)
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Grid
from terrainwave.grid.quantum import Quantizer
from terrainwave.names import BOTH, MESHES, METHODS, SIDES, UNBOUNDED_MESHES

MAGIC = b"\x89TWZ\r\n\x1a\n"  # like PNG's: visibly damaged by a text-mode or 7-bit copy
FORMAT_VERSION = 2
HEADER_SIZE = 128  # without optional sections
MEDIA_TYPE = "application/vnd.terrainwave"  # FORMAT.md §14
# Ending of the messages of `UnsupportedVersionError` (FORMAT.md §12.1).
NEWER = ": install a newer terrainwave"

_METHOD_NAMES = {method.number: method.name for method in METHODS.values()}
# Codes 2 (int8) and 5 (uint32) are reserved.
DTYPE_CODES = {"uint8": 1, "uint16": 3, "int16": 4, "int32": 6, "float32": 7, "float64": 8}
# Samples of the full grid may be void (FORMAT.md §5.2).
HAS_VOIDS = 1
# Remainders make every height of the full grid exact (FORMAT.md §5.3).
HAS_REMAINDERS = 2
# The file follows the paper of its method (FORMAT.md §7.9).
IS_FAITHFUL = 4
# Corrections in payloads keep a patch from changing other heights (FORMAT.md §5.4).
HAS_CORRECTIONS = 8
# The file ends with digests of its heights (FORMAT.md §4.9).
HAS_DIGESTS = 16
KNOWN_FEATURES = HAS_VOIDS | HAS_REMAINDERS | IS_FAITHFUL | HAS_CORRECTIONS | HAS_DIGESTS

MAX_SIDE = 2**31
MAX_SAMPLES = 2**50
MIN_BLOCK_LOG2, MAX_BLOCK_LOG2 = 5, 10
MAX_EFFORT = 9
MAX_MESH_TOLERANCE = 2**32 - 1
MAX_QUANTUM_PART = 2**63 - 1
MAX_Z = 2**30  # so that z ± half a step and differences of two heights fit int32
MAX_STEP = 2**31 - 1
MAX_METADATA = 2**20  # both deflated and inflated
MAX_PARAMETERS = 2**16
SMALLEST_DIGESTS = 40  # the section of one digest (FORMAT.md §4.9)
MAX_PAGE = 2**15  # an inflated page has at most 5.9 kB (FORMAT.md §10)

# Fields of the fixed header in their order; the others are those of `Header` and `Extents`.
_LAYOUT = struct.Struct("<8s B B H I Q I I B B B B B B 2s Q Q q I i i I d d d I I I I I")
_FIELDS = (
    "magic version reserved header_size features file_size n_rows n_cols block_log2 border_rings"
    " method dtype effort mesh padding numerator denominator base step z_min z_max metadata_length"
    " max_error effective_bound rho metadata_crc parameters_length parameters_crc top_page_length"
    " mesh_tolerance"
).split()
_CRC = struct.Struct("<I")
# Head of an optional section: name, length of its content, its checksum (FORMAT.md §4.8).
_SECTION = struct.Struct("<4s I I")


class _Feature:
    """Property of a header: True if the file has a feature of the mask."""

    def __init__(self, bit: int) -> None:
        self._bit = bit

    def __get__(self, header: "Header", _: object = None) -> bool:
        return bool(header.features & self._bit)


@dataclass(frozen=True)
class Header:
    """Properties of the whole raster (FORMAT.md §4.1).

    The raw height of quantum number k is ``(base + k) * quantum``, in the units of the source's
    stored values (before scale and offset).

    `n_rows`, `n_cols`: size of the raster; 1 ... 2^31 each, at most 2^50 samples.
    `block`: cells per side of a block; a power of two, 32 ... 1024.
    `border_rings`: 1 or 3.
    `method`: one of `names.METHODS`.
    `dtype`: data type of the source and of `read`, one of `DTYPE_CODES`.
    `effort`: effort of the encoder, 0 ... 9.
    `quantum`: height of one quantum, raw units; > 0.
    `base`: added to every quantum number. ``(abs(base) + 2**31) * quantum.numerator < 2**63``.
    `step`: quantizer width in quanta; odd.
    `z_min`, `z_max`: smallest and largest valid height of the originals, in quanta, within ±2^30; 0
        and -1 if there is no valid sample.
    `max_error`, `effective_bound`, `rho`: requested bound, effective bound, and its share lost to
        rounding; raw units.
    `mesh`: the triangulation of every block, one of `names.MESHES`.
    `mesh_tolerance`: its tolerance on the finest level, in 1/16 quanta; 0 without meshes.
    `features`: must-understand mask: a sum of `HAS_VOIDS`, `HAS_REMAINDERS`, `IS_FAITHFUL`,
        `HAS_CORRECTIONS`, `HAS_DIGESTS`.
    `metadata`: the JSON metadata (`container.metadata`).
    `file_tables`: tables of the method for the whole file (FORMAT.md §4.3); opaque here, at most 64
        KiB.
    """

    n_rows: int
    n_cols: int
    block: int
    border_rings: int
    method: str
    dtype: str
    effort: int
    quantum: Fraction
    base: int
    step: int
    z_min: int
    z_max: int
    max_error: float
    effective_bound: float
    rho: float
    mesh: str = "none"
    mesh_tolerance: int = 0
    features: int = 0
    metadata: dict[str, object] = field(default_factory=dict, hash=False)
    file_tables: bytes = b""

    @property
    def grid(self) -> Grid:
        return Grid(self.n_rows, self.n_cols, self.block)

    has_voids = _Feature(HAS_VOIDS)
    has_remainders = _Feature(HAS_REMAINDERS)
    is_faithful = _Feature(IS_FAITHFUL)
    has_corrections = _Feature(HAS_CORRECTIONS)
    has_digests = _Feature(HAS_DIGESTS)

    @property
    def moved(self) -> int:
        found = self.metadata.get("moved")
        return int(cast(float, found)) if found is not None else 0

    @property
    def bound_side(self) -> str:
        found = self.metadata.get("bound")
        return str(found) if found in SIDES else BOTH

    @property
    def is_proved(self) -> bool:
        """Return False if the writer says that it did not compare all samples with originals."""
        return self.metadata.get("proof") != "none"

    @property
    def coded_error(self) -> int:
        """Return the largest distance of decoded from quantised original heights, in quanta."""
        half = self.step >> 1
        # Off the grid a one-sided file leaves a quantum for rounding.
        on_one_side = half + (self.rho > 0)
        return half + (0 if self.bound_side == BOTH else on_one_side) + self.moved

    @property
    def quanta_error(self) -> float:
        """Return the bound of quantised heights, used in meshes, in raw units."""
        if self.has_remainders:
            return self.quantizer.quanta_error + self._moved_error
        return self.effective_bound

    @property
    def effective_error(self) -> float:
        """Return the effective bound with the earlier loss of exact heights, in raw units."""
        return self.effective_bound + (self._moved_error if self.has_remainders else 0.0)

    @property
    def _moved_error(self) -> float:
        return float(self.moved * self.quantum)

    @cached_property
    def quantizer(self) -> Quantizer:
        return Quantizer(
            dtype=self.dtype,
            numerator=self.quantum.numerator,
            denominator=self.quantum.denominator,
            base=self.base,
            step=self.step,
            rho=self.rho,
            z_min=self.z_min,
            z_max=self.z_max,
            remainder_bytes=np.dtype(self.dtype).itemsize if self.has_remainders else 0,
        )

    @cached_property
    def codec_parameters(self) -> CodecParameters:
        nodata = self.metadata.get("nodata")
        # A string is NaN or an infinity, which no quantum equals.
        number = nodata if isinstance(nodata, int | float) else None
        return CodecParameters.of(
            self.quantizer,
            number,
            self.border_rings,
            self.effort,
            is_faithful=self.is_faithful,
            has_voids=self.has_voids,
            has_corrections=self.has_corrections,
        )


@dataclass(frozen=True)
class Extents:
    """Sizes and checksums that only the writer of the whole file knows (FORMAT.md §4.1)."""

    file_size: int
    metadata_length: int
    metadata_crc: int
    parameters_length: int
    parameters_crc: int
    top_page_length: int
    header_size: int = HEADER_SIZE

    @property
    def parameters_start(self) -> int:
        return self.header_size + self.metadata_length

    @property
    def top_start(self) -> int:
        return self.parameters_start + self.parameters_length


def pack_header(header: Header, extents: Extents) -> bytes:
    """Return the 128 bytes of the header (FORMAT.md §4.1)."""
    if header.block.bit_count() != 1 or header.block < 1:
        raise InvalidHeightsError(f"block is {header.block}, not a power of two")
    for name, known in (("method", METHODS), ("mesh", MESHES), ("dtype", DTYPE_CODES)):
        found = getattr(header, name)
        if found not in known:
            raise InvalidHeightsError(f"unknown {name} {found!r}; known: {', '.join(known)}")
    for problem in _violations(header, extents):
        raise InvalidHeightsError(str(problem))
    values = vars(header) | vars(extents)
    values |= {
        "magic": MAGIC,
        "version": FORMAT_VERSION,
        "reserved": 0,
        "padding": bytes(2),
        "block_log2": header.block.bit_length() - 1,
        "method": METHODS[header.method].number,
        "dtype": DTYPE_CODES[header.dtype],
        "mesh": MESHES.index(header.mesh),
        "numerator": header.quantum.numerator,
        "denominator": header.quantum.denominator,
    }
    body = _LAYOUT.pack(*(values[name] for name in _FIELDS))
    return body + _CRC.pack(zlib.crc32(body))


# First bytes of other kinds of files.
_KINDS = {
    b"II*\0": "a TIFF", b"MM\0*": "a TIFF", b"II+\0": "a TIFF", b"MM\0+": "a TIFF",
    b"\x89PNG": "a PNG", b"PK\x03\x04": "a zip archive", b"\x1f\x8b": "a gzip file",
    b"\x89HDF": "an HDF5 or NetCDF file", b"CDF": "a NetCDF file", b"GRIB": "a GRIB file",
    b"<!DOCTYPE html": "a web page", b"<html": "a web page", b"<?xml": "an XML file",
}  # fmt: skip


class NotTwzError(CorruptStreamError):
    """The file is of another kind, and another copy will not help."""


def _kind_of(data: bytes) -> str:
    start = data[:32].lstrip().lower()
    kinds = (kind for magic, kind in _KINDS.items() if start.startswith(magic.lower()))
    return next(kinds, "another kind of file")


def unpack_header(data: bytes) -> tuple[Header, Extents]:
    """Read and check a header (FORMAT.md §4.1), without metadata and tables, which follow it."""
    if not data:
        raise TruncatedStreamError("found an empty file, expected a .twz file")
    if data[: len(MAGIC)] != MAGIC[: len(data)]:
        if data[:4] == MAGIC[:4]:
            raise CorruptStreamError(
                "found a .twz file whose line ends were changed, as a transfer in text mode does"
            )
        raise NotTwzError(f"found {_kind_of(data)}, expected a .twz file")
    if len(data) < HEADER_SIZE:
        raise TruncatedStreamError(f"the file ends in its header, at byte {len(data)}")
    (stored,) = _CRC.unpack_from(data, _LAYOUT.size)
    _check_version(data, stored)
    body = data[: _LAYOUT.size]
    values = dict(zip(_FIELDS, _LAYOUT.unpack(body), strict=True))
    method, dtype, mesh = (values.pop(name) for name in ("method", "dtype", "mesh"))
    numerator, denominator = values.pop("numerator"), values.pop("denominator")
    block_log2, size = values["block_log2"], values["header_size"]
    if size < HEADER_SIZE:
        raise CorruptStreamError(f"header size {size}, less than {HEADER_SIZE} (byte 10)")
    if stored != zlib.crc32(body):
        raise CorruptStreamError("checksum of the header does not match")
    if values["reserved"] or values["padding"] != bytes(2):
        raise UnsupportedVersionError(f"a reserved field of the header is not 0{NEWER}")
    if not MIN_BLOCK_LOG2 <= block_log2 <= MAX_BLOCK_LOG2:
        raise CorruptStreamError(f"log2 of the block size is {block_log2}, not 5 ... 10 (byte 32)")
    if method not in _METHOD_NAMES:
        raise UnsupportedVersionError(f"unknown method {method} (byte 34){NEWER}")
    if mesh >= len(MESHES):
        raise UnsupportedVersionError(f"unknown mesh {mesh} (byte 37){NEWER}")
    names = {code: name for name, code in DTYPE_CODES.items()}
    if dtype not in names:
        raise UnsupportedVersionError(f"unknown data type {dtype} (byte 35){NEWER}")
    if not 0 < numerator <= MAX_QUANTUM_PART or not 0 < denominator <= MAX_QUANTUM_PART:
        raise CorruptStreamError(f"quantum {numerator}/{denominator} is not positive and < 2^63")
    if math.gcd(numerator, denominator) != 1:
        raise CorruptStreamError(f"quantum {numerator}/{denominator} is not in lowest terms")
    header = Header(
        block=1 << block_log2,
        method=_METHOD_NAMES[method],
        dtype=names[dtype],
        quantum=Fraction(numerator, denominator),
        mesh=MESHES[mesh],
        **_of_class(Header, values),
    )
    extents = Extents(**_of_class(Extents, values))
    for problem in _violations(header, extents):
        raise problem
    return header, extents


def _of_class(kind: Any, values: dict[str, Any]) -> dict[str, Any]:
    return {one.name: values[one.name] for one in fields(kind) if one.name in values}


def _check_version(data: bytes, stored: int) -> None:
    """Raise if the format's version differs from ours; `stored` is the checksum of the header."""
    version = data[8]
    if version == FORMAT_VERSION:
        return
    first = data[:8] + bytes([FORMAT_VERSION]) + data[9 : _LAYOUT.size]
    if stored == zlib.crc32(first):  # other versions have checksums of their own
        raise CorruptStreamError(
            f"byte 8 is damaged: it says format version {version}, and the checksum is that of"
            f" version {FORMAT_VERSION}"
        )
    advice = NEWER
    if version < FORMAT_VERSION:
        advice = ": made by a development build: compress the raster again"
    raise UnsupportedVersionError(
        f"found format version {version}, expected {FORMAT_VERSION}{advice}"
    )


def check_optional_sections(data: bytes) -> None:
    names, at = set[bytes](), 0
    while at < len(data):
        start = at + _SECTION.size
        if start > len(data):
            raise CorruptStreamError("the head of an optional section is cut short")
        name, length, stored = _SECTION.unpack_from(data, at)
        at = start + length
        if at > len(data):
            raise CorruptStreamError(f"the optional section {name!r} reaches beyond the header")
        if name in names:
            raise CorruptStreamError(f"the optional section {name!r} comes twice")
        if stored != zlib.crc32(data[start:at]):
            raise CorruptStreamError(f"the checksum of the optional section {name!r} is wrong")
        names.add(name)


def _violations(header: Header, extents: Extents) -> Iterator[TerrainwaveError]:
    """Yield violations of the limits of FORMAT.md §4.1 and §10, in the order of the fields."""
    unknown = header.features & ~KNOWN_FEATURES
    if unknown:
        yield UnsupportedVersionError(f"unknown features {unknown:#x}{NEWER}")
    for name, side in (("n_rows", header.n_rows), ("n_cols", header.n_cols)):
        if not 1 <= side <= MAX_SIDE:
            yield CorruptStreamError(f"{name} is {side}, not 1 ... 2^31")
    if header.n_rows * header.n_cols > MAX_SAMPLES:
        yield CorruptStreamError(f"{header.n_rows} x {header.n_cols} samples are more than 2^50")
    if not MIN_BLOCK_LOG2 <= header.block.bit_length() - 1 <= MAX_BLOCK_LOG2:
        yield CorruptStreamError(f"block is {header.block}, not 32 ... 1024")
    if header.border_rings not in (1, 3):
        yield CorruptStreamError(f"border_rings is {header.border_rings}, not 1 or 3")
    if not 0 <= header.effort <= MAX_EFFORT:
        yield UnsupportedVersionError(f"effort is {header.effort}, not 0 ... 9{NEWER}")
    numerator = header.quantum.numerator
    if not 0 < numerator <= MAX_QUANTUM_PART or header.quantum.denominator > MAX_QUANTUM_PART:
        yield CorruptStreamError(f"quantum {header.quantum} is not positive and of parts < 2^63")
    # Keeps (base + k) * numerator inside int64 for every int32 k.
    if (abs(header.base) + 2**31) * numerator > 2**63 - 1:
        yield CorruptStreamError(
            f"base {header.base} and quantum {header.quantum} overflow 64 bits"
        )
    if not (1 <= header.step <= MAX_STEP and header.step & 1):
        yield CorruptStreamError(f"step is {header.step}, not an odd number below 2^31")
    if (header.z_min, header.z_max) != (0, -1) and not (
        -MAX_Z <= header.z_min <= header.z_max <= MAX_Z and header.z_max - header.z_min < MAX_Z
    ):
        yield CorruptStreamError(
            f"heights {header.z_min} ... {header.z_max} quanta are out of range"
        )
    errors = (header.max_error, header.effective_bound, header.rho)
    if not all(math.isfinite(error) and error >= 0 for error in errors):
        yield CorruptStreamError("an error bound is negative or not finite")
    if header.effective_bound > header.max_error:
        yield CorruptStreamError(
            f"effective bound {header.effective_bound} exceeds {header.max_error}"
        )
    yield from _violations_of_features(header)
    yield from _violations_of_sizes(header, extents)


def _violations_of_features(header: Header) -> Iterator[TerrainwaveError]:
    method = METHODS[header.method]
    for is_used, is_known, what in (
        (
            header.border_rings != 1,
            method.has_rings,
            f"border_rings is {header.border_rings}, not 1,",
        ),
        (header.mesh in UNBOUNDED_MESHES, method.has_coefficients, f"the mesh {header.mesh}"),
        (header.is_faithful, method.may_be_faithful, "a faithful file"),
        (header.has_remainders, method.has_remainders, "remainders"),
    ):
        if is_used and not is_known:
            yield CorruptStreamError(f"{what} of method {header.method}, which has none")
    if header.z_min > header.z_max and not header.has_voids:
        yield CorruptStreamError("no sample is valid, and none may be void")
    if header.has_corrections and (not method.is_patchable or header.step == 1):
        what = f"corrections of method {header.method} and step {header.step}"
        yield UnsupportedVersionError(f"{what}{NEWER}")
    if header.has_remainders:
        if header.dtype not in ("int32", "float32", "float64"):
            yield CorruptStreamError(f"remainders of {header.dtype}, which has none")
        if header.effective_bound or header.step != 1:
            yield CorruptStreamError("remainders beside a step or a bound that is not 0")
    elif header.rho > header.max_error:
        yield CorruptStreamError(f"rounding loss {header.rho} exceeds max_error {header.max_error}")


def _violations_of_sizes(header: Header, extents: Extents) -> Iterator[TerrainwaveError]:
    if not 0 <= header.mesh_tolerance <= MAX_MESH_TOLERANCE:
        yield CorruptStreamError(f"mesh tolerance {header.mesh_tolerance} does not fit 32 bits")
    if header.mesh == "none" and header.mesh_tolerance:
        yield CorruptStreamError("a mesh tolerance without meshes")
    if not 1 <= extents.metadata_length <= MAX_METADATA:
        yield CorruptStreamError(f"metadata of {extents.metadata_length} bytes, not 1 ... 2^20")
    if not 0 <= extents.parameters_length <= MAX_PARAMETERS:
        yield CorruptStreamError(
            f"method parameters of {extents.parameters_length} bytes, more than 2^16"
        )
    if not 1 <= extents.top_page_length <= MAX_PAGE:
        yield CorruptStreamError(f"top page of {extents.top_page_length} bytes, not 1 ... 2^15")
    end = extents.top_start + extents.top_page_length
    end += SMALLEST_DIGESTS * header.has_digests
    if not end <= extents.file_size < 2**63:
        yield CorruptStreamError(
            f"file size {extents.file_size} does not hold the first {end} bytes"
        )
