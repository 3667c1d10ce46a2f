"""The `rapid` method, with tables of the file (docs/format-rapid.md)."""

from functools import lru_cache

from terrainwave.codec.rapid.coder import UnitCoder
from terrainwave.codec.rapid.file_tables import (
    FileTables,
    Tables,
    pack_file_tables,
    parse_file_tables,
)
from terrainwave.codec.refiner import Each
from terrainwave.grid.quadtree import Grid
from terrainwave.grid.sample_windows import HeightsOf, MaskOf


class RapidRefiner(UnitCoder):
    """The refiner; see `Refiner`."""

    name = "rapid"

    def __init__(self, file_tables: bytes = b"", tables: FileTables | None = None) -> None:
        """Take a file's tables from their bytes, unless they are known."""
        super().__init__(_tables_of(file_tables) if tables is None else Tables(tables))
        self.file_tables = file_tables

    def fitted(
        self,
        grid: Grid,
        step: int,
        heights: HeightsOf,
        mask: MaskOf,
        *,
        each: Each = map,
    ) -> "RapidRefiner":
        """Return a refiner with tables fitted to a raster.

        `heights` and `mask` return targets and validity of a region of a level.
        """
        from terrainwave.codec.rapid.fit import fit_tables

        tables = fit_tables(grid, step, heights, mask, each=each)
        return RapidRefiner(pack_file_tables(tables), tables)


@lru_cache(maxsize=8)
def _tables_of(file_tables: bytes) -> Tables:
    """Return the tables of a file; those who open it again find them, and what decoders made."""
    return parse_file_tables(file_tables)
