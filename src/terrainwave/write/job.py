"""What every pass over a raster has to know, and the header that follows from it."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction

from terrainwave._version import __version__
from terrainwave.codec.units import CodecParameters
from terrainwave.container.header import Header
from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.quadtree import Grid
from terrainwave.grid.quantum import Quantizer, as_fraction
from terrainwave.mesh.blocks import mesh_tolerance
from terrainwave.raster_io.info import RasterInfo


@dataclass(frozen=True)
class Job:
    """What is settled once a raster has been scanned: plain values, the same on every machine.

    Attributes
    ----------
    bound : Fraction
        The bound asked for, in physical units; of an embedded file 0 until it has been measured.
    effort, border_rings, mesh : int, int, str
        As in the file's header.
    mesh_error : float, optional
        As in `compress`.
    n_valid : int
        Samples of the raster that are valid.
    rate, psnr : float, optional
        As in `compress`.
    measured : float, optional
        The error of an embedded file, once it is known; in raw units.
    """

    info: RasterInfo
    quantizer: Quantizer
    grid: Grid
    bound: Fraction
    effort: int
    border_rings: int
    mesh: str
    mesh_error: float | None
    n_valid: int
    rate: float | None = None
    psnr: float | None = None
    measured: float | None = None

    @property
    def is_embedded(self) -> bool:
        """Say whether streams are cut by size or mean error, not by a bound."""
        return self.rate is not None or self.psnr is not None

    @property
    def effective_error(self) -> float:
        """Return the bound that holds, in raw units."""
        return self.quantizer.effective_error if self.measured is None else self.measured

    def with_measured(self, error: int) -> "Job":
        """Return the job with a measured error, in quanta, as the bound."""
        # That of a bounded file whose steps have this half.
        measured = replace(self.quantizer, step=2 * error + 1).effective_error
        return replace(self, measured=measured, bound=as_fraction(measured) * scale_of(self.info))

    @property
    def has_voids(self) -> bool:
        """Say whether any sample of the raster is void."""
        return self.n_valid < self.grid.n_rows * self.grid.n_cols

    @property
    def raw_bound(self) -> float:
        """Return the bound asked for, in raw units."""
        return float(self.bound / scale_of(self.info))

    @property
    def lost(self) -> int:
        """Return the largest loss by rounding to quanta, in quanta, rounded up."""
        return self.quantizer.lost

    @property
    def mesh_tolerance(self) -> int:
        """Return the tolerance of the finest meshes in 1/16 quanta, rounded down; 0 without."""
        quantizer = self.quantizer
        if self.mesh == "none":
            return 0
        if self.mesh_error is None:
            error = max(Fraction(self.effective_error), Fraction(quantizer.quantum))
        else:
            error = as_fraction(self.mesh_error) / scale_of(self.info)
        return mesh_tolerance(error, Fraction(quantizer.numerator, quantizer.denominator))

    @property
    def parameters(self) -> CodecParameters:
        """Return the parameters that all units share."""
        quantizer = self.quantizer
        return CodecParameters(
            step=quantizer.step,
            z_min=quantizer.z_min,
            z_max=quantizer.z_max,
            forbidden=quantizer.quanta_of_value(self.info.nodata),
            rings=self.border_rings,
            effort=self.effort,
        )

    def header(self, method: str, parameters: bytes) -> Header:
        """Return the header of a file coded with `method`, whose tables are `parameters`."""
        quantizer, info = self.quantizer, self.info
        plain = RasterInfo(info.n_rows, info.n_cols, info.dtype).to_metadata()
        # Only what is not as it would be anyway; size and type are in the header itself.
        metadata = {key: value for key, value in info.to_metadata().items() if value != plain[key]}
        has_heights = self.n_valid > 0
        return Header(
            n_rows=info.n_rows,
            n_cols=info.n_cols,
            block=self.grid.block,
            border_rings=self.border_rings,
            method=method,
            dtype=info.dtype,
            effort=self.effort,
            quantum=Fraction(quantizer.numerator, quantizer.denominator),
            base=quantizer.base,
            step=quantizer.step,
            z_min=quantizer.z_min if has_heights else 0,
            z_max=quantizer.z_max if has_heights else -1,
            max_error=self.raw_bound,
            effective_bound=min(self.effective_error, self.raw_bound),
            rho=quantizer.rho,
            mesh=self.mesh,
            mesh_tolerance=self.mesh_tolerance,
            metadata={**metadata, "software": f"terrainwave {__version__}"},
            parameters=parameters,
        )


def scale_of(info: RasterInfo) -> Fraction:
    """Return physical units per raw one, without sign.

    Raises
    ------
    InvalidHeightsError
        If it is 0 or not finite.
    """
    if info.scale == 0 or not math.isfinite(info.scale):
        raise InvalidHeightsError(
            f"the raster's scale is {info.scale:g}, expected a finite number that is not 0: correct"
            " its metadata"
        )
    return abs(as_fraction(info.scale))
