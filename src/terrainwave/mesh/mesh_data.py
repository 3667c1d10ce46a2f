"""`MeshData`: the numbers of a mesh in world coordinates."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import count_of, crs_name, in_one_line

# Share of the error left by heights for the curvature of a globe; the rest is the mesh's. 1/16 took
# the fewest triangles on rasters of 30 to 100 m (1/32 … 1/2 were tried).
CURVATURE_SHARE = 1 / 16


class CurvatureShare(NamedTuple):
    """Error in the file's unit that the curvature of a globe may add to a mesh on it."""

    error: float  # 0: as small as possible without dividing cells
    # shape (2, 3); two opposite corners of a cell in the middle of the raster, at height 0
    cell: NDArray[np.float64] | None = None
    # the curvature adds as little as this number of triangles allows, down to `error`
    max_triangles: int | None = None


@dataclass(frozen=True, repr=False)
class MeshData:
    """Triangulated surface in world coordinates; `export.mesh.Mesh` describes the fields.

    `attributes` are passed on with the mesh: ``is_placed`` (x and y are georeferenced),
    ``impossible`` (why they are on no globe), ``area`` (for `area`), ``share`` (for `share`),
    ``curvature`` (a `CurvatureShare`), ``footprint`` (the `Footprint` of the raster).
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    origin: tuple[float, float, float]
    error: float
    crs: str | None = None
    units: str | None = None
    attributes: dict[str, Any] = field(default_factory=dict)
    heights_are: str | None = None

    def __repr__(self) -> str:
        return in_one_line(
            f"<Mesh: {count_of(self.n_triangles, 'triangle')}, {self.n_vertices:,} vertices,"
            f" within {self.error:.6g} {self.units or '(unit unknown)'}, {crs_name(self.crs)}>"
        )

    @property
    def n_vertices(self) -> int:
        return len(self.vertices)

    @property
    def n_triangles(self) -> int:
        return len(self.triangles)

    @property
    def points(self) -> NDArray[np.float64]:
        return self.vertices + np.asarray(self.origin)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return (left, bottom, right, top) of the vertices in the CRS."""
        if not self.n_vertices:
            raise ValueError("the mesh is empty: it has no bounds")
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    @property
    def share(self) -> float | None:
        """Return the share of samples within tolerance; None for meshes that guarantee it.

        It counts samples of the mesh's level under it, and uses the tolerance of guaranteed meshes.
        """
        return self.attributes.get("share")

    @property
    def area(self) -> tuple[float, float, float, float]:
        """Return (left, bottom, right, top) of the meshed area, in the CRS.

        Between the centres of its outermost pixels. With voids there, `bounds` is smaller, and
        differs from that of other meshes of the area. By default the result is `bounds`.
        """
        area = self.attributes.get("area")
        return self.bounds if area is None else area


def used_only(
    vertices: NDArray[np.float64], triangles: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return vertices and triangles without the vertices that no triangle has."""
    used, number = np.unique(triangles, return_inverse=True)
    return vertices[used], number.reshape(triangles.shape).astype(np.int32)


def walls_below(
    starts: NDArray[Any], ends: NDArray[Any], starts_below: NDArray[Any], ends_below: NDArray[Any]
) -> NDArray[Any]:
    """Return the two triangles of a wall below each edge, facing outwards."""
    return np.concatenate([
        np.column_stack([ends, starts, starts_below]),
        np.column_stack([ends, starts_below, ends_below]),
    ])  # fmt: skip
