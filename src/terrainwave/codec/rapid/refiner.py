"""The `rapid` method, with tables of the file (docs/format-rapid.md)."""

from terrainwave.codec.rapid.file_tables import pack_file_tables, tables_of
from terrainwave.codec.rapid.tables import Tables
from terrainwave.codec.rapid.unit import UnitCoder
from terrainwave.codec.refiner import Each
from terrainwave.grid.quadtree import Grid
from terrainwave.grid.sample_windows import HeightsOf, MaskOf


class RapidRefiner(UnitCoder):
    """The refiner; see `Refiner`."""

    name = "rapid"

    def __init__(self, file_tables: bytes = b"") -> None:
        """Take a file's tables as their bytes."""
        self.file_tables = file_tables

    def tables(self, step: int) -> Tables:
        """Return the file's tables; those who open it again find them."""
        return tables_of(self.file_tables, step)

    def fitted(
        self, grid: Grid, step: int, heights: HeightsOf, mask: MaskOf, *, each: Each = map
    ) -> "RapidRefiner":
        """Return a refiner with tables fitted to a raster.

        `heights` and `mask` return targets and validity of a region of a level.
        """
        from terrainwave.codec.rapid.fit import fit_tables

        return RapidRefiner(pack_file_tables(fit_tables(grid, step, heights, mask, each=each)))
