"""Interface of refiners, which convert one coded unit of heights to a payload and back.

A coded unit is a root block or a group (the four children of one block). A refiner sees only its
`GroupSpec` and the decoded heights of the parent block: no file, no global, no neighbour. That
makes every group decodable from only its ancestors, in any order.

Functions of this package that read bytes raise `CorruptStreamError` where these contradict
FORMAT.md, `TruncatedStreamError` where they end too early.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self, TypeVar, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.remainders import Remainders
from terrainwave.grid.sample_windows import HeightsOf, MaskOf

Heights = NDArray[np.int32]
Mask = NDArray[np.bool_]
Labels = NDArray[np.uint8]
_T = TypeVar("_T")
_Made = TypeVar("_Made")


class Sides(NamedTuple):
    """Sides of a coded unit that have a neighbour on the same level."""

    top: bool
    left: bool
    bottom: bool
    right: bool


class Rows(NamedTuple):
    """Range of rows of a unit: the first, and the one after the last, clipped to the unit."""

    first: int
    end: int


ALL_ROWS = Rows(0, 1 << 31)
NOT_SHARED = Sides(False, False, False, False)


@dataclass(frozen=True, kw_only=True)
class GroupSpec(CodecParameters):
    """Parameters of a coded unit: all that a refiner knows besides its parent's heights.

    Regions are in sample indices of their own level; sample (r, c) of the parent's level lies on
    sample (2r, 2c) of this one. `core` is the group itself; `region` adds the apron, the one more
    ring of samples towards each neighbour that `rings` = 3 codes (without, it equals `core`). A
    root block has no parent and `parent_region` is None.
    """

    level: int
    core: Region
    region: Region
    parent_region: Region | None
    shared: Sides
    # Only for choices of encoders, and for the sections of a payload: no refiner may decode by it.
    is_finest: bool = True
    # True if `Decoded.labels` are wanted of a method that codes them.
    wants_labels: bool = True
    # True if residuals of this level are quantised as the paper prints it for coarse levels.
    has_coarse_residuals: bool = False

    @classmethod
    def alone(
        cls,
        core: Region,
        step: int,
        z_min: int,
        z_max: int,
        *,
        region: Region | None = None,
        parent_region: Region | None = None,
        shared: Sides = NOT_SHARED,
        forbidden: tuple[int, int] = (1, 0),
        effort: int = 0,
    ) -> Self:
        """Return the spec of a unit outside of a file, by default one without neighbours.

        `codec.unit_specs.unit_spec` returns those of a file's units.
        """
        return cls(
            step, z_min, z_max, forbidden, 1, effort, level=1, core=core, region=region or core,
            parent_region=parent_region, shared=shared,
        )  # fmt: skip

    @property
    def half(self) -> int:
        """Return the largest error of a decoded sample, in quanta: ``(step - 1) / 2``."""
        return self.step >> 1


class Validity(NamedTuple):
    """Validity of a region's samples; read-only.

    `mask`: None if all are valid, as in most units. `own`: None if all valid samples are valid by
    themselves, in the full grid, and not only next to valid ones (`codec.masks`).
    """

    mask: Mask | None
    own: Mask | None = None

    @classmethod
    def of(cls, mask: Mask, own: Mask | None = None) -> Self:
        """Return the validity given by arrays; this is the only place that scans them."""
        is_apart = own is not None and not np.array_equal(own, mask)
        return cls(None if mask.all() else mask, own if is_apart else None)

    @property
    def own_mask(self) -> Mask | None:
        """Return which samples are valid by themselves; None if all are."""
        return self.mask if self.own is None else self.own

    @property
    def nbytes(self) -> int:
        """Return the bytes of the arrays."""
        return sum(part.nbytes for part in self if part is not None)

    def part(self, at: tuple[slice, slice]) -> "Validity":
        """Return the validity of some samples; views."""
        return Validity(*(None if part is None else part[at] for part in self))

    def copy(self) -> "Validity":
        """Return a copy with its own arrays."""
        return Validity(*(None if part is None else part.copy() for part in self))


ALL_VALID = Validity(None)


def all_void(shape: tuple[int, int]) -> Validity:
    """Return the validity of a region without a valid sample."""
    return Validity(np.zeros(shape, dtype=np.bool_))


def as_array(mask: Mask | None, shape: tuple[int, ...]) -> Mask:
    """Return a mask as an array; None means that all samples are valid."""
    return np.ones(shape, dtype=np.bool_) if mask is None else mask


class Decoded(NamedTuple):
    """Heights (int32 quanta) and validity of a unit's region, with its zero trees if any.

    `labels`: a map of zero trees as in `coding.zerotrees`, one byte per finest node of the core. In
    a group these are the samples of the parent block inside the raster, without apron. None if the
    method has no details (`store`, raw units) or nothing is valid. `remainders`: differences from
    exact heights (`grid.remainders`); None if all are 0. `rows`: the rows with decoded heights;
    others are undefined in `heights`, but known in all else. `is_raw`: `heights` are raw heights,
    not quanta, as a `Raw` asked for.
    """

    heights: Heights
    validity: Validity
    labels: Labels | None = None
    remainders: Remainders | None = None
    rows: Rows = ALL_ROWS
    is_raw: bool = False

    @property
    def mask(self) -> Mask:
        """Return which samples are valid, as an array."""
        return as_array(self.validity.mask, self.heights.shape)

    @property
    def own_mask(self) -> Mask:
        """Return which samples are valid by themselves, as an array."""
        return as_array(self.validity.own_mask, self.heights.shape)

    @property
    def nbytes(self) -> int:
        """Return the bytes of the arrays."""
        parts = self.heights, self.validity, self.labels, self.remainders
        return sum(part.nbytes for part in parts if part is not None)

    def part(self, at: tuple[slice, slice]) -> "Decoded":
        """Return some samples, a subset of `rows`, without the zero trees; views."""
        rest = None if self.remainders is None else self.remainders[at]
        return Decoded(self.heights[at], self.validity.part(at), None, rest, is_raw=self.is_raw)


class Raw(NamedTuple):
    """Memory for the raw heights of a unit: its quanta plus `base`.

    `heights`: its region, or all but the last row or column; a part of a flat array of whole
    numbers that they all fit.
    """

    heights: NDArray[Any]
    base: int


class Refiner(Protocol):
    """Interface of a method; `codec.group` adds masks, clamping and exceptions."""

    name: str

    def encode(
        self, spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None
    ) -> tuple[bytes, Heights, Labels | None]:
        """Return the payload and exactly what `decode` makes of it.

        `mask` is None if all samples are valid. Every valid one must come back within ``spec.half``
        of `target`, which must not be changed: the caller still needs it.
        """
        ...

    def decode(
        self, spec: GroupSpec, parent: Heights | None, mask: Mask | None, payload: bytes
    ) -> tuple[Heights, Labels | None]:
        """Rebuild the heights of ``spec.region``; raise `CorruptStreamError` for bad bytes."""
        ...


class Corrections(NamedTuple):
    """Corrections in a refiner's loop; contiguous arrays of a unit's region, or empty ones.

    `kept`: heights that an encoder must reproduce, `FREE` where it may choose. `added`: corrections
    added to heights before others use them; filled by an encoder, zeros before.
    """

    kept: Heights
    added: Heights


FREE = np.int32(-(2**31))
MAX_CORRECTION = 2**31 - 1
_NONE = np.zeros((0, 0), dtype=np.int32)
NO_CORRECTIONS = Corrections(_NONE, _NONE)


class CorrectingRefiner(Protocol):
    """A refiner whose loop has corrections (`codec.corrections`)."""

    def encode(
        self, spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> tuple[bytes, Heights, Labels | None]:  # fmt: skip
        """Do as `Refiner.encode`, and reproduce the kept heights."""
        ...

    def decode(
        self, spec: GroupSpec, parent: Heights | None, mask: Mask | None, payload: bytes,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> tuple[Heights, Labels | None]:  # fmt: skip
        ...


class DirectRefiner(CorrectingRefiner, Protocol):
    """A refiner that decodes into given memory; heights lie within the spec's range."""

    def decode_into(
        self, spec: GroupSpec, parent: Heights | None, mask: Mask | None, payload: bytes,
        out: Heights, corrections: Corrections = NO_CORRECTIONS, rows: Rows = ALL_ROWS,
        raw: Raw | None = None,
    ) -> bool:  # fmt: skip
        """Do as `decode`; `out` is contiguous and has the shape of ``spec.region``.

        Returns whether heights went to `raw` instead. Nothing does if it raises.

        If only some `rows` of a group are needed, bytes of other rows may be skipped; heights in
        these rows, and in rows of `parent` outside `rows_above`, are undefined.
        """
        ...

    def rows_above(self, spec: GroupSpec, payload: bytes, rows: Rows) -> Rows:
        """Return the rows of its parent that some rows of a group need.

        Raises
        ------
        CorruptStreamError
            If the payload begins with invalid bytes.
        """
        ...


class Each(Protocol):
    """Map function: `map`, or that of an executor, which runs in parallel."""

    def __call__(self, make: Callable[[_T], _Made], things: Iterable[_T], /) -> Iterator[_Made]: ...


def as_direct(refiner: Refiner) -> DirectRefiner | None:
    """Return a refiner that decodes into given memory, else None; `isinstance` takes 0.1 ms."""
    return cast(DirectRefiner, refiner) if hasattr(refiner, "decode_into") else None


@runtime_checkable
class FittingRefiner(Refiner, Protocol):
    """A refiner with tables for the whole file; `file_tables` are their bytes in the header."""

    file_tables: bytes

    def fitted(
        self,
        grid: Grid,
        step: int,
        heights: HeightsOf,
        mask: MaskOf,
        *,
        each: Each = map,
    ) -> "FittingRefiner":
        """Return a refiner with tables fitted to a raster, the same ones on every machine.

        `heights` and `mask` return targets and validity of a region of a level. `each` distributes
        the work and does not affect the result.
        """
        ...
