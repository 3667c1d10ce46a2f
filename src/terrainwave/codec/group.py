"""Code one unit: its mask, its heights by a refiner, its exceptions (FORMAT.md §5).

Payload: one byte of flags; the flagged sections of mask, exceptions, remainders and corrections
(each a varint length and its bytes); then the refiner's bytes to the end. An empty payload is a
unit without a valid sample.
"""

from collections.abc import Callable
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.corrections import decode_corrections, encode_corrections
from terrainwave.codec.masks import Above, decode_validity, encode_validity
from terrainwave.codec.memory import new_heights
from terrainwave.codec.refiner import (
    ALL_ROWS,
    FREE,
    NO_CORRECTIONS,
    CorrectingRefiner,
    Corrections,
    Decoded,
    GroupSpec,
    Heights,
    Mask,
    Raw,
    Refiner,
    Rows,
    Validity,
    all_void,
    as_direct,
)
from terrainwave.codec.remainder_planes import decode_remainders, encode_remainders
from terrainwave.codec.varint import decode_varint, encode_varint
from terrainwave.errors import CorruptStreamError, TruncatedStreamError
from terrainwave.grid.remainders import Remainders

MASK_CODED = 1
_HAS_EXCEPTIONS, _HAS_REMAINDERS, HAS_CORRECTIONS = 0b10, 0b100, 0b1000
# In file order.
_SECTIONS = MASK_CODED, _HAS_EXCEPTIONS, _HAS_REMAINDERS, HAS_CORRECTIONS


def encode_unit(
    refiner: Refiner,
    spec: GroupSpec,
    parent: Decoded | None,
    target: Heights,
    mask: Mask,
    remainders: Callable[[Heights], Remainders] | None = None,
    own: Mask | None = None,
    kept: Heights | None = None,
) -> tuple[bytes, Decoded]:
    """Return the payload of a unit and its decoded form.

    Parameters
    ----------
    target : ndarray of int32, shape ``spec.region.shape``
        Heights to approximate, in quanta; void samples hold their fill.
    mask : ndarray of bool, same shape
        True for valid samples. Must be False wherever the parent implies a void.
    remainders : callable, optional
        Returns the remainders of decoded heights; only with ``spec.remainder_bytes``.
    own : ndarray of bool, optional
        True for samples that are valid by themselves; by default all valid ones, as on the finest
        level.
    kept : ndarray of int32, optional
        Only with ``spec.has_corrections``: heights that must come back exactly, `FREE` where any
        height within the bound of `target` is accepted.
    """
    sections = dict.fromkeys(_SECTIONS, b"")
    validity = Validity.of(mask, own)
    if validity.own_mask is not None:  # otherwise the parent implies no void
        if not mask.any():
            return b"", _all_void(spec)
        above = _above(spec, parent)
        sections[MASK_CODED] = encode_validity(
            validity, spec.region, above, is_finest=spec.is_finest
        )
    parent_heights = None if parent is None else parent.heights
    corrections = NO_CORRECTIONS
    if kept is None:
        body, heights, labels = refiner.encode(spec, parent_heights, target, validity.mask)
    else:
        target = np.where(kept == FREE, target, kept)
        corrections = Corrections(np.ascontiguousarray(kept), np.zeros_like(kept))
        correcting = cast(CorrectingRefiner, refiner)
        body, heights, labels = correcting.encode(
            spec, parent_heights, target, validity.mask, corrections
        )
    if as_direct(refiner) is None:
        np.clip(heights, spec.z_min, spec.z_max, out=heights)
    collides = _collisions(spec, heights, validity.mask)
    if collides is not None and collides.any():
        # A height that equals nodata itself (after rounding) goes up if there is room.
        goes_down = (target[collides] < spec.forbidden[0]) | (spec.forbidden[1] >= spec.z_max)
        if goes_down.any():
            sections[_HAS_EXCEPTIONS] = np.packbits(goes_down).tobytes()
        _resolve_collisions(spec, heights, collides, goes_down)
    decoded = Decoded(heights, validity, labels)
    if remainders is not None:
        rest = remainders(heights)
        sections[_HAS_REMAINDERS] = encode_remainders(rest)
        if sections[_HAS_REMAINDERS]:
            decoded = decoded._replace(remainders=rest)
    sections[HAS_CORRECTIONS] = encode_corrections(corrections.added, spec)
    head = bytes([sum(flag for flag, section in sections.items() if section)])
    head += b"".join(encode_varint(len(one)) + one for one in sections.values() if one)
    return head + body, decoded


def decode_unit(
    refiner: Refiner,
    spec: GroupSpec,
    parent: Decoded | None,
    payload: bytes,
    rows: Rows = ALL_ROWS,
    raw: Raw | None = None,
) -> Decoded:
    """Undo `encode_unit`. The mask is read-only. Heights may go to `raw`.

    If only some rows are needed, and the refiner is a `DirectRefiner`, a group may have heights
    only in these (`Decoded.rows`), and the bytes of the others may be unchecked. The parent needs
    heights only in the rows returned by `rows_above`.
    """
    if not payload:
        if not spec.has_voids:
            raise CorruptStreamError("a unit without a payload in a file without voids")
        return _all_void(spec)
    head = read_head(spec, parent, payload)
    mask = head.validity.mask
    remainders = None
    if head.remainders:
        remainders = decode_remainders(head.remainders, spec.region.shape, spec.remainder_bytes)
    parent_heights = None if parent is None else parent.heights
    direct, body = as_direct(refiner), payload[head.n_bytes :]
    if direct is None or parent is None:
        rows = ALL_ROWS
    rows = _from_first(rows, head.exceptions)
    is_part = rows.first > 0 or rows.end < spec.region.n_rows
    corrections = NO_CORRECTIONS
    if head.corrections:
        corrections = decode_corrections(head.corrections, spec)
    if direct is not None:
        heights = new_heights(spec.region.shape)
        labels = None
        if head.remainders or spec.forbidden[0] <= spec.forbidden[1]:
            raw = None  # quanta are looked at
        if direct.decode_into(spec, parent_heights, mask, body, heights, corrections, rows, raw):
            assert raw is not None
            return Decoded(raw.heights, head.validity, is_raw=True)
    else:
        if head.corrections:
            correcting = cast(CorrectingRefiner, refiner)
            heights, labels = correcting.decode(spec, parent_heights, mask, body, corrections)
        else:
            heights, labels = refiner.decode(spec, parent_heights, mask, body)
        np.clip(heights, spec.z_min, spec.z_max, out=heights)
    decoded = Decoded(heights, head.validity, labels, remainders, rows if is_part else ALL_ROWS)
    if is_part:
        at = slice(rows.first, rows.end)
        heights, mask = heights[at], None if mask is None else mask[at]
    collides = _collisions(spec, heights, mask)
    n_collisions = 0 if collides is None else int(np.count_nonzero(collides))
    # Raises if there are too many.
    goes_down = _decode_exceptions(head.exceptions, n_collisions, is_part=is_part)
    if collides is not None:
        _resolve_collisions(spec, heights, collides, goes_down)
    return decoded


def rows_above(refiner: Refiner, spec: GroupSpec, payload: bytes, rows: Rows) -> Rows:
    """Return the rows of its parent that `decode_unit` needs for some rows of a group."""
    direct = as_direct(refiner)
    if direct is None:
        return ALL_ROWS
    if not payload:
        return Rows(0, 1)
    sections, byte_pos = _read_sections(payload)
    rows = _from_first(rows, sections[_HAS_EXCEPTIONS])
    return direct.rows_above(spec, payload[byte_pos:], rows)


def _from_first(rows: Rows, exceptions: bytes) -> Rows:
    """Return rows, from the first on if there are exceptions, which are counted from there."""
    return Rows(0, rows.end) if exceptions else rows


class Head(NamedTuple):
    """Start of a unit's payload: validity, other sections, its length."""

    validity: Validity
    exceptions: bytes
    remainders: bytes
    corrections: bytes
    n_bytes: int


def read_head(spec: GroupSpec, parent: Decoded | None, payload: bytes) -> Head:
    """Read the sections before the heights of a non-empty payload."""
    flags = payload[0]
    known = _HAS_EXCEPTIONS | (_HAS_REMAINDERS if spec.remainder_bytes else 0)
    if spec.has_voids:
        known |= MASK_CODED
    if spec.has_corrections:
        known |= HAS_CORRECTIONS
    if flags & ~known:
        raise CorruptStreamError(f"a unit's flags are {flags:#04x}; reserved bits must be 0")
    sections, byte_pos = _read_sections(payload)
    above = _above(spec, parent)
    validity = decode_validity(sections[MASK_CODED], spec.region, above, is_finest=spec.is_finest)
    if validity.mask is not None and not validity.mask.any():
        raise CorruptStreamError("a unit without a valid sample has a payload")
    return Head(
        validity,
        sections[_HAS_EXCEPTIONS],
        sections[_HAS_REMAINDERS],
        sections[HAS_CORRECTIONS],
        byte_pos,
    )


def _above(spec: GroupSpec, parent: Decoded | None) -> Above | None:
    if parent is None or spec.parent_region is None:
        return None
    return Above(spec.parent_region, parent.validity)


def _all_void(spec: GroupSpec) -> Decoded:
    shape = spec.region.shape
    return Decoded(np.zeros(shape, dtype=np.int32), all_void(shape))


def _collisions(spec: GroupSpec, heights: Heights, mask: Mask | None) -> Mask | None:
    """Return the valid samples whose height equals the nodata value; None if none can."""
    low, high = spec.forbidden
    if low > high:
        return None
    collides: Mask = (heights >= low) & (heights <= high)
    return collides if mask is None else mask & collides


def _resolve_collisions(
    spec: GroupSpec, heights: Heights, collides: Mask, goes_down: NDArray[np.bool_]
) -> None:
    """Move colliding heights to the next value on the original's side, in place."""
    low, high = spec.forbidden
    heights[collides] = np.where(goes_down, low - 1, high + 1)


def _decode_exceptions(section: bytes, n_collisions: int, *, is_part: bool) -> NDArray[np.bool_]:
    """Return which heights go down; with `is_part` the section may have more entries."""
    if not section:
        return np.zeros(n_collisions, dtype=np.bool_)
    n_needed = (n_collisions + 7) // 8
    if len(section) < n_needed or (len(section) > n_needed and not is_part):
        raise CorruptStreamError(
            f"{n_collisions} heights equal nodata, but {len(section)} bytes of exceptions are"
            " present"
        )
    bits = np.unpackbits(np.frombuffer(section, dtype=np.uint8))
    if bits[n_collisions:].any() and not is_part:
        raise CorruptStreamError("the last byte of the exceptions is not filled with 0")
    return bits[:n_collisions].astype(np.bool_)


def _read_sections(payload: bytes) -> tuple[dict[int, bytes], int]:
    """Return the sections of a payload by flag, empty without one, and the place after them."""
    sections, byte_pos = dict.fromkeys(_SECTIONS, b""), 1
    for flag in _SECTIONS:
        if payload[0] & flag:
            length, byte_pos = decode_varint(payload, byte_pos)
            if length == 0:
                raise CorruptStreamError(f"a section is empty (byte {byte_pos})")
            if byte_pos + length > len(payload):
                raise TruncatedStreamError(
                    f"a section of {length} bytes is cut short (byte {byte_pos})"
                )
            sections[flag] = payload[byte_pos : byte_pos + length]
            byte_pos += length
    return sections, byte_pos
