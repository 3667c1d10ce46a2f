"""What all coded units of a file have in common (FORMAT.md §2.4)."""

from dataclasses import dataclass
from typing import Self

from terrainwave.grid.quantum import Quantizer


@dataclass(frozen=True)
class CodecParameters:
    """What all units of a file have in common."""

    step: int
    z_min: int
    z_max: int
    forbidden: tuple[int, int]
    rings: int
    effort: int
    # Bytes per sample of remainders, which make heights exact beyond their quanta; 0 without.
    remainder_bytes: int = 0
    # Whether the file follows its method's paper (FORMAT.md §7.9).
    is_faithful: bool = False
    # Whether samples may be void (FORMAT.md §5.2).
    has_voids: bool = True
    # Whether payloads may put heights back in the loop (FORMAT.md §5.4).
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
        """Return the parameters of heights with a nodata value, in raw units, if there is one."""
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
