"""Restricted quadtrees: as files store them, and as they follow a camera."""

from dataclasses import dataclass

from terrainwave.errors import InvalidArgumentError
from terrainwave.names import Method, methods_that
from terrainwave.option_sets import option, words
from terrainwave.tri.mesh_options import MeshOptions


@dataclass(frozen=True, kw_only=True)
class Rqt(MeshOptions):
    """Options of restricted quadtrees.

    Parameters
    ----------
    select : str
        Selection of vertices: ``"error"`` keeps all samples within `mesh_error`. ``"coefficient"``,
        with method cdf53, selects vertices with a wavelet coefficient above `mesh_error`, like
        Zheng, Wang and Wang; the error is measured, and may be larger.
    """

    name = "rqt"

    select: str = option(
        words("error", "coefficient"),
        "What selects vertices: error, so that all samples are within --mesh-error (default); or"
        " coefficient, with method cdf53, their wavelet coefficients: the error is measured.",
        default="error",
    )

    def stored(self, method: Method, *, is_faithful: bool) -> str:  # noqa: ARG002
        """Return the kind of meshes that a file of a method holds."""
        if self.select == "error":
            return self.name
        if not method.has_coefficients:
            raise InvalidArgumentError(
                f"found `select`={self.select} for a file of method {method.name}, expected one of"
                f" method {methods_that(lambda one: one.has_coefficients)}, whose coefficients it"
                " follows"
            )
        return f"{self.name}-{self.select}"
