"""Heights that a patched file must hold: the new raster's, and those known around it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.refiner import Mask
from terrainwave.errors import InvalidHeightsError
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import places_to_pixels
from terrainwave.grid.quadtree import Region
from terrainwave.place.meaning import RADIUS
from terrainwave.place.units import height_unit, kind_problem, meeting
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.raster_io.source import RasterSource

_WINDOW = 512
# Largest misalignment of a raster with the file's samples, in pixels.
_MISALIGNED = 1e-3


def check_units(terrain: TerrainFile, source: RasterSource) -> str:
    """Return a note on units of a raster and of the file that it patches; "" if all is well."""
    info = terrain.raster_info
    found = source.settled(info.crs)
    # Plain arrays do not say that they are depths.
    is_told = source.told is not None or RADIUS in (info.heights_are, found and found.kind)
    if found is not None and is_told:
        held = terrain.info()
        own = info.own_kind(held.minimum, held.maximum, is_asked=source.is_asked)
        problem = kind_problem(own, (found, info.crs))
        if problem is not None:
            raise InvalidHeightsError(
                f"{source.name}: {problem}: convert the numbers, depths for example by gdal_calc"
                " --calc=-A, or say what they are by `heights_are`"
            )
    unit = height_unit(source.info.units, source.info.crs)
    met = meeting(source.name, unit, "the file", terrain.height_unit)
    if met.problem:
        raise InvalidHeightsError(met.problem)
    return met.note


def original_source(terrain: TerrainFile, original: Any) -> RasterSource:
    """Open the raster that a file was made from, with the file's nodata value."""
    info = terrain.raster_info
    return RasterSource(original, nodata="none" if info.mask_kind == "none" else info.nodata)


def place_of(info: RasterInfo, new: RasterInfo) -> Region:
    """Return the samples of a file that a raster covers."""
    for name in ("dtype", "scale", "offset"):
        expected, found = getattr(info, name), getattr(new, name)
        if found != expected:
            raise InvalidHeightsError(f"the new raster's {name} is {found}, expected {expected}")
    if new.crs != info.crs and new.rasterio_crs() != info.rasterio_crs():
        raise InvalidHeightsError(
            f"the new raster's CRS is {new.crs}, expected that of the file, {info.crs}"
        )
    a, b, _, d, e, _ = info.transform
    pixel = max(abs(a), abs(b), abs(d), abs(e))
    sizes = zip(new.transform, info.transform, strict=True)
    linear = [abs(one - other) for i, (one, other) in enumerate(sizes) if i not in (2, 5)]
    row, col = places_to_pixels(info.transform, new.transform[2], new.transform[5])
    n_longest = max(new.n_rows, new.n_cols)
    is_aligned = max(linear) * n_longest < _MISALIGNED * pixel
    is_aligned &= max(abs(col - round(col)), abs(row - round(row))) < _MISALIGNED
    if not is_aligned:
        raise InvalidHeightsError(
            "the new raster does not lie on the file's grid: found the transform"
            f" {new.transform}, expected {info.transform} moved by whole pixels"
        )
    place = Region(round(row), round(col), new.n_rows, new.n_cols)
    if place.intersect(Region(0, 0, info.n_rows, info.n_cols)) != place:
        raise InvalidHeightsError(
            f"the new raster reaches beyond the file: it begins at row {place.row}, column"
            f" {place.col} and has {new.n_rows} x {new.n_cols} samples of"
            f" {info.n_rows} x {info.n_cols}; cut it"
        )
    return place


class Merged:
    """The new raster where it lies; elsewhere the original, or the file's decoded heights.

    `place` is the region whose originals are known: everything if an original is given. `has_voids`
    is true if samples may be void in it. `notes` state assumptions.
    """

    def __init__(
        self, terrain: TerrainFile, source: RasterSource, original: RasterSource | None = None
    ) -> None:
        self._terrain = terrain
        self._source = source
        self.has_voids = terrain.header.has_voids
        sources = [source] if original is None else [source, original]
        self.notes = [*filter(None, (check_units(terrain, one) for one in sources))]
        self._new_place = place_of(terrain.raster_info, source.info)
        self._original = original
        self.place = self._new_place
        if original is not None:
            self.place = place_of(terrain.raster_info, original.info)
            if self.place.shape != terrain.shape:
                raise InvalidHeightsError(
                    f"the original has {self.place.n_rows} x {self.place.n_cols} samples, expected"
                    f" the raster that the file was made of, {terrain.shape[0]} x"
                    f" {terrain.shape[1]}"
                )
        self._check()

    @property
    def info(self) -> RasterInfo:
        return self._terrain.raster_info

    @property
    def is_open(self) -> bool:
        """Return whether heights beyond the new raster are known only from the file."""
        return self.place.shape != self._terrain.shape

    def beyond(self, region: Region, stride: int) -> Mask:
        """Return which samples of a region, `stride` apart, are known only from the file."""
        rows, cols = (
            (stride * np.arange(first, first + n) - start).astype(np.uint64) >= size
            for first, n, start, size in (
                (region.row, region.n_rows, self.place.row, self.place.n_rows),
                (region.col, region.n_cols, self.place.col, self.place.n_cols),
            )
        )
        return rows[:, None] | cols

    def covers(self, region: Region) -> bool:
        return region.intersect(self.place) == region

    def known(self, region: Region, mask: Mask) -> Mask:
        """Return which samples of a mask have a known original."""
        if self.covers(region):
            return mask
        known = np.zeros_like(mask)
        at = region.intersect(self.place).slices_in(region)
        known[at] = mask[at]
        return known

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        region = Region(row, col, n_rows, n_cols)
        part = region.intersect(self._new_place)
        if part == region:
            return self._new(region)
        if self._original is None:
            heights, valid = self._terrain.read_with_mask(region)
        else:
            heights, valid = self._original.read(*region)
        heights, valid = heights.copy(), valid.copy()
        if part.n_rows and part.n_cols:
            at = part.slices_in(region)
            heights[at], valid[at] = self._new(part)
        return heights, valid

    def _new(self, region: Region) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        row, col = region.row - self._new_place.row, region.col - self._new_place.col
        return self._source.read(row, col, *region.shape)

    def _check(self) -> None:
        quantizer, header = self._terrain.quantizer, self._terrain.header
        ranges: dict[str, tuple[float, float]] = {}
        for window in self.place.tiles(_WINDOW, _WINDOW):
            raw, valid = self.read(*window)
            self._check_original(window, raw, valid)
            is_new = np.zeros(window.shape, dtype=np.bool_)
            is_new[window.intersect(self._new_place).slices_in(window)] = True
            for name, which in (("the new raster", is_new), ("the original", ~is_new)):
                if not which.any():
                    continue
                heights = self._checked_heights(name, raw, valid, which)
                if heights.size:
                    lowest, highest = ranges.get(name, (np.inf, -np.inf))
                    ends = min(lowest, heights.min()), max(highest, heights.max())
                    ranges[name] = ends
        low, high = (quantizer.height_of(number) for number in (header.z_min, header.z_max))
        slack = quantizer.quantum / 2 if quantizer.rho else 0.0
        for name, (lowest, highest) in ranges.items():
            if lowest < low - slack or highest > high + slack:
                wanted = self._range_text(min(lowest, low), max(highest, high))
                raise InvalidHeightsError(
                    f"{name} has heights from {lowest:.10g} to {highest:.10g}, the file can hold"
                    f" {low:.10g} to {high:.10g} (stored units): units that stay are decoded with"
                    " this range, so it cannot grow. Compress the whole raster again, with"
                    f" `height_range` {wanted} to leave room for patches"
                )

    def _range_text(self, low: float, high: float) -> str:
        info = self._terrain.raster_info
        ends = sorted(info.scale * end + info.offset for end in (low, high))
        return ",".join(f"{end:.15g}" for end in ends)  # repeating this option makes room for both

    def _checked_heights(
        self, name: str, raw: NDArray[Any], valid: NDArray[np.bool_], which: Mask
    ) -> NDArray[np.float64]:
        """Return the valid heights of a raster; raise unless the file can represent them."""
        quantizer, info = self._terrain.quantizer, self._terrain.raster_info
        taken = valid & which
        is_any_void = not valid[which].all()
        self.has_voids |= is_any_void
        if info.mask_kind == "none" and is_any_void:
            raise InvalidHeightsError(
                f"{name} has voids, and the file has no way to mark them: compress the whole raster"
                " again"
            )
        heights = raw[taken].astype(np.float64)
        if heights.size == 0:
            return heights
        if info.nodata is not None and (heights == info.nodata).any():
            raise InvalidHeightsError(
                f"{name} has valid heights of {info.nodata:g}, the file's nodata value: they would"
                " be read as voids. If they are voids, say so with `nodata`; else compress the"
                " whole raster again"
            )
        if self._terrain.header.z_min > self._terrain.header.z_max:
            raise InvalidHeightsError(
                f"{name} has heights, and the file has voids alone, so that it has no range of"
                " heights: compress the whole raster again"
            )
        decoded = quantizer.dequantize(quantizer.quantize(raw, taken))
        if not quantizer.rho and not np.array_equal(decoded[taken], raw[taken]):
            raise InvalidHeightsError(
                f"{name} has heights that are no multiples of the file's vertical step"
                f" {quantizer.quantum:g} (stored units): round them, or compress the whole raster"
                " again"
            )
        return heights

    def _check_original(self, region: Region, raw: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        """Raise `InvalidHeightsError` if the file was made from another original.

        Usually it lacks an earlier patch, which would be undone silently.
        """
        if self._original is None:
            return
        stored, was_valid = self._terrain.read_with_mask(region)
        quantizer, bound = self._terrain.quantizer, self._terrain.header.effective_bound
        allowed = bound + quantizer.float_error + quantizer.quantum / 2
        both = valid & was_valid
        apart = np.zeros(region.shape)
        np.subtract(raw, stored, out=apart, where=both, dtype=np.float64)
        is_other = (valid != was_valid) | (np.abs(apart) > allowed)
        is_other[region.intersect(self._new_place).slices_in(region)] = False
        if is_other.any():
            row, col = np.argwhere(is_other)[0]
            found = raw[row, col] if valid[row, col] else "void"
            held = stored[row, col] if was_valid[row, col] else "void"
            raise InvalidHeightsError(
                f"the original is {found} at row {row + region.row}, column {col + region.col},"
                f" where the file has {held} (stored units): expected the raster that the file was"
                f" made of, within {bound:g} of it; bring it up to date with all earlier patches"
            )
