"""The `rapid` method, with tables of the file (docs/format-rapid.md)."""

from collections.abc import Callable
from functools import lru_cache

from terrainwave.codec.rapid.coder import UnitCoder
from terrainwave.codec.rapid.file_tables import (
    FileTables,
    Tables,
    pack_parameters,
    parse_parameters,
)
from terrainwave.codec.refiner import Heights, Mask
from terrainwave.grid.quadtree import Grid, Region


class Rapid(UnitCoder):
    """The refiner; see `Refiner`."""

    name = "rapid"

    def __init__(self, parameters: bytes = b"", tables: FileTables | None = None) -> None:
        """Take a file's tables from their bytes, unless they are known."""
        super().__init__(_tables_of(parameters) if tables is None else Tables(tables))
        self.parameters = parameters

    def fitted(
        self,
        grid: Grid,
        step: int,
        heights: Callable[[int, Region], Heights],
        mask: Callable[[int, Region], Mask],
        *,
        may_have_reach: bool = True,
    ) -> "Rapid":
        """Return a refiner with tables fitted to a raster.

        `heights` and `mask` return targets and validity of a region of a level.
        """
        from terrainwave.codec.rapid.fit import fit_tables

        tables = fit_tables(grid, step, heights, mask, may_have_reach=may_have_reach)
        return Rapid(pack_parameters(tables), tables)


@lru_cache(maxsize=8)
def _tables_of(parameters: bytes) -> Tables:
    """Return the tables of a file; those who open it again find them, and what decoders made."""
    return parse_parameters(parameters)
