"""Summary of a file in one record: `Info`."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from terrainwave.file.described import DescribedFile
from terrainwave.names import EFFORTS
from terrainwave.raster_io.raster_info import earlier_files


@dataclass(frozen=True)
class Info:
    """Summary of a .twz file; errors are in physical units.

    `faithful` is true if the file was made with `faithful=True` (`Cdf97`). `float_error` is the
    amount by which stored floats may exceed `max_error`: one float spacing if they represent
    decimal numbers and the file is not strict, otherwise 0. `bound` is the side of the original on
    which heights lie: ``"both"``, ``"above"`` (none is below its original) or ``"below"``.
    `proved` is False if the file was made without the proof: decoding and comparing every sample.
    `moved_error` is the part of `effective_error` that comes from an earlier file. `earlier` lists
    the .twz files that the heights went through before: ``"file"`` and its bound from the original,
    ``"max_error"``. `units` is the unit of heights, and `units_from` its origin: the ``"band"`` or
    the ``"CRS"``. `units_of_crs` is the unit of the CRS's vertical axis, if the band names another
    one. `heights_are` is the meaning of the numbers: ``"height"``, ``"depth"`` or ``"radius"``.
    `voids` is the source's marking of voids: ``"none"``, a ``"nodata"`` value, ``"nan"`` or a
    ``"mask"``. `has_voids` is False if no sample is void.
    """

    path: str
    n_bytes: int
    n_rows: int
    n_cols: int
    dtype: str
    bits_per_sample: float
    ratio: float
    max_error: float
    effective_error: float
    bound: str
    proved: bool
    quantum: float
    rounding_error: float
    float_error: float
    moved_error: float
    units: str | None
    units_from: str | None
    units_of_crs: str | None
    heights_are: str
    method: str
    effort: str
    faithful: bool
    block: int
    border_rings: int
    mesh: str
    mesh_tolerance: float
    measured_meshes: bool
    n_levels: int
    level_shapes: tuple[tuple[int, int], ...]
    crs: str | None
    coordinate_epoch: float | None
    transform: tuple[float, ...]
    bounds: tuple[float, float, float, float]
    nodata: float | int | None
    scale: float
    offset: float
    area_or_point: str | None
    description: str | None
    minimum: float | None
    maximum: float | None
    voids: str
    has_voids: bool
    tags: dict[str, str]
    band_tags: dict[str, str]
    color_interpretation: str | None
    earlier: tuple[dict[str, Any], ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values; values that JSON lacks become strings."""
        fields = asdict(self)
        if isinstance(self.nodata, float) and not np.isfinite(self.nodata):
            fields["nodata"] = str(self.nodata)
        return fields


# Fields that header and metadata have by the same names.
_OF_HEADER = ("n_rows", "n_cols", "dtype", "method", "block", "border_rings", "mesh")
_OF_RASTER = (
    "crs", "coordinate_epoch", "nodata", "scale", "offset", "area_or_point", "description",
    "color_interpretation",
)  # fmt: skip


def info_of(terrain: DescribedFile) -> Info:
    """Return a summary of the file, from its header and its first index page."""
    header, raster = terrain.header, terrain.raster_info
    n_samples = header.n_rows * header.n_cols
    quantum = terrain.quantizer.quantum * abs(raster.scale)
    is_strict = terrain.quantizer.is_strict(header.max_error, header.effective_bound)
    float_error = 0.0 if is_strict else terrain.quantizer.float_error
    has_heights = header.z_min <= header.z_max
    physical = [
        terrain.quantizer.height_of(quantum) * raster.scale + raster.offset
        for quantum in (header.z_min, header.z_max)
    ]
    return Info(
        path=str(terrain.name),
        n_bytes=terrain.container.source.size,
        **{name: getattr(header, name) for name in _OF_HEADER},
        **{name: getattr(raster, name) for name in _OF_RASTER},
        bits_per_sample=8 * terrain.container.source.size / n_samples,
        ratio=n_samples * terrain.dtype.itemsize / terrain.container.source.size,
        max_error=terrain.max_error,
        effective_error=terrain.effective_error,
        bound=header.bound_side,
        proved=header.is_proved,
        quantum=quantum,
        rounding_error=terrain.quantizer.rho * abs(raster.scale),
        float_error=float_error * abs(raster.scale),
        moved_error=header.moved * quantum,
        units=terrain.units,
        units_from=terrain.height_unit.source,
        units_of_crs=terrain.height_unit.of_crs,
        heights_are=terrain.height_unit.word,
        effort=EFFORTS[min(header.effort, len(EFFORTS) - 1)],
        faithful=header.is_faithful,
        mesh_tolerance=header.mesh_tolerance / 16 * quantum,
        measured_meshes=terrain.has_measured_meshes,
        n_levels=terrain.n_levels,
        level_shapes=tuple(terrain.grid.level_shape(level) for level in range(terrain.n_levels)),
        transform=tuple(raster.transform),
        bounds=terrain.bounds,
        minimum=min(physical) if has_heights else None,
        maximum=max(physical) if has_heights else None,
        voids=raster.mask_kind,
        has_voids=header.has_voids,
        tags=dict(raster.tags),
        band_tags=dict(raster.band_tags),
        earlier=tuple(file._asdict() for file in earlier_files(header.metadata)),
    )
