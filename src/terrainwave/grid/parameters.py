"""Parameters shared by all coded units of a file (FORMAT.md §2.4)."""

from dataclasses import dataclass
from typing import Self

from terrainwave.grid.quantum import Quantizer


@dataclass(frozen=True)
class CodecParameters:
    """Parameters shared by all units of a file."""

    step: int
    z_min: int
    z_max: int
    forbidden: tuple[int, int]
    rings: int
    effort: int
    # Bytes per sample of remainders, which make heights exact beyond their quanta; else 0.
    remainder_bytes: int = 0
    # True if the file follows its method's paper (FORMAT.md §7.9).
    is_faithful: bool = False
    # True if samples may be void (FORMAT.md §5.2).
    has_voids: bool = True
    # True if payloads may have corrections (FORMAT.md §5.4).
    has_corrections: bool = False

    @property
    def apron(self) -> int:
        """Return how many samples of its neighbours a block has on each side."""
        return 1 if self.rings == 3 else 0

    @classmethod
    def of(
        cls,
        quantizer: Quantizer,
        nodata: float | int | None,
        rings: int,
        effort: int,
        *,
        is_faithful: bool = False,
        has_voids: bool = True,
        has_corrections: bool = False,
    ) -> Self:
        """Return the parameters of heights with a nodata value, in raw units, if any."""
        return cls(
            step=quantizer.step,
            z_min=quantizer.z_min,
            z_max=quantizer.z_max,
            forbidden=quantizer.quanta_of_value(nodata),
            rings=rings,
            effort=effort,
            remainder_bytes=quantizer.remainder_bytes,
            is_faithful=is_faithful,
            has_voids=has_voids,
            has_corrections=has_corrections,
        )
