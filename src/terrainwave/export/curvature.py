"""Distance of flat triangles from a curved body, and division of edges to keep a bound.

Let G be the map from the coordinates of a mesh (x, y, height) to geocentric ones, and m the
distance of G(middle of an edge) from the middle of the edge's ends on the globe. If G has second
degree, a point of a triangle with barycentric coordinates λ is off by e(λ) = 4 Σ λᵢ λⱼ mᵢⱼ, as
vectors: the second derivative D gives Σ λᵢ G(uᵢ) − G(Σ λᵢ uᵢ) = ½ Σ λᵢ λⱼ D(uᵢ − uⱼ)² over the
three edges, and λ = ½, ½ gives m = ⅛ D(uᵢ − uⱼ)². `_worst_inside` is the largest value of this sum
over a triangle: max m in triangles with a right angle, 4/3 m in those with equal edges. G's third
derivative adds a share of that, which sinks with the edges; `_THIRD_DEGREE` allows for it on edges
up to `_LONGEST` of the body's radius.

An edge is halved while m exceeds a limit. m depends only on the edge's two ends, so the triangles,
blocks or tiles on both sides divide it alike.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import AS_IS, check_vertical
from terrainwave.errors import InvalidHeightsError
from terrainwave.mesh.mesh_data import CurvatureShare, MeshData
from terrainwave.place.ellipsoid import Ellipsoid
from terrainwave.place.position import Place
from terrainwave.place.units import HeightUnit, height_unit
from terrainwave.place.vertical import (
    EllipsoidalHeights,
    describe_as_is,
    describe_radii,
    onto_wgs84,
)

Numbers = NDArray[np.float64]

# Allowance, as a factor of a triangle's error, for terms of third degree and more.
_THIRD_DEGREE = 9 / 8
# Longest edges, in radii, for which such terms are small. Their middle is L²/8R off.
_LONGEST = 1 / 16
# The same if a datum's grid, with a kink at each of its lines, bends the surface: a kink near an
# edge's end is twice its m away from it.
_KINKS = 2.0
# Largest number of triangles that division may add.
_MOST_ADDED = 1 << 22
# Steps of the search for the smallest limit within a budget of triangles.
_BUDGET_STEPS, _BUDGET_RATIO = 12, 1.02
_NONE = -1


@dataclass(frozen=True)
class GlobeWay:
    """Conversion of a mesh's points to the globe."""

    place: Place
    metres: float  # per unit of height; negative if the CRS counts depths
    # None: heights are assumed to be above the ellipsoid
    vertical: EllipsoidalHeights | None = None
    z_scale: float = 1.0  # factor of heights
    is_radius: bool = False  # heights are distances from the body's centre

    def describe(self, crs: str | None) -> dict[str, Any]:
        if self.is_radius:
            return describe_radii()
        return describe_as_is(crs) if self.vertical is None else self.vertical.describe()

    @property
    def slack(self) -> float:
        """Return the factor of `_worst_inside` that bounds a triangle's error."""
        return _THIRD_DEGREE if self.vertical is None else _KINKS

    @property
    def of_edges(self) -> float:
        """Return the share of a triangle's error that m of its edges may take."""
        return 1 / (4 / 3 * self.slack)

    @property
    def per_unit(self) -> float:
        """Return the metres on the globe per unit of height."""
        return abs(self.metres) * self.z_scale

    def geographic(self, points: Numbers) -> Numbers:
        """Return (longitude, latitude in degrees, height in metres) of points in the CRS.

        On WGS 84 for the Earth, else on the datum of the CRS.
        """
        placed = points.copy()
        placed[:, :2] = self.place.to_lonlat(points[:, :2])
        placed[:, 2] *= self.metres
        if self.is_radius:
            ellipsoid = self.place.globe_ellipsoid
            placed[:, 2] = ellipsoid.heights_of_radii(placed[:, 1], placed[:, 2])
        if not np.isfinite(placed).all():
            raise InvalidHeightsError(
                "a part of the mesh has no longitude and latitude in its coordinate reference"
                " system"
            )
        if self.vertical is not None:
            placed[:, 2] = self.vertical.heights(points[:, 0], points[:, 1], placed[:, 2])
        return placed

    def geocentric(self, points: Numbers) -> Numbers:
        """Return geocentric x, y, z in metres of points in the CRS, heights scaled."""
        placed = self.geographic(points)
        placed[:, 2] *= self.z_scale
        return self.place.globe_ellipsoid.geocentric(placed)


def mesh_unit(mesh: MeshData) -> HeightUnit:
    return height_unit(mesh.units, mesh.crs, mesh.heights_are)


def way_onto_globe(
    mesh: MeshData, place: Place, vertical: str = AS_IS, z_scale: float = 1.0
) -> GlobeWay:
    if "impossible" in mesh.attributes:
        raise InvalidHeightsError(mesh.attributes["impossible"])
    unit = mesh_unit(mesh)
    is_converted = check_vertical(vertical) and not unit.is_radius
    converts = onto_wgs84(place, mesh.bounds) if is_converted else None
    return GlobeWay(place, unit.metres, converts, z_scale, unit.is_radius)


def curvature(mesh: MeshData, way: GlobeWay) -> float:
    """Return the largest distance of flat triangles from the curved surface, in metres.

    Vertically: along the normal of the ellipsoid at the point of the surface.

    A point of a triangle is off by at most e, its triangle's error. The horizontal part of e moves
    it by at most e, which lifts it by the slopes on its path. The path may enter other triangles.
    Where e changes by at most half a metre per metre, it is at most twice the error of each
    triangle that the path enters, as the path begins no further than its own length from there. So
    the point is lifted by at most max 2 σ e, with the slope σ and the error of the same triangle.
    Triangles too narrow for this count with the steepest slope of all.
    """
    found = _Bends(mesh, way)
    per_edge = found.of_triangles
    errors = way.slack * _worst_inside(per_edge)
    corners = found.on_globe[mesh.triangles]
    sides = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)
    rise, twice_areas = rises(corners, way.place.globe_ellipsoid)
    rise = np.abs(rise)
    # Walls of bodies and skirts, vertical up to rounding, are not part of the surface.
    is_ground = rise > 1e-6 * twice_areas
    if not is_ground.any():
        return float(errors.max(initial=0.0))
    slopes = np.sqrt(np.maximum((twice_areas[is_ground] / rise[is_ground]) ** 2 - 1, 0))
    # The gradient of linear interpolation's error, for second derivatives up to `bend`: J.
    # Shewchuk, What is a good linear element? (2002), table 1.
    bend = float((8 * per_edge / np.maximum(sides, 1.0) ** 2).max())
    ordered = np.sort(sides[is_ground], axis=1)
    inside = 2 * twice_areas[is_ground] / ordered.sum(axis=1) / 2
    spread = ordered[:, 2] * ordered[:, 1] * (ordered[:, 0] + 4 * inside)
    is_narrow = bend * spread > 0.5 * 4 * twice_areas[is_ground]
    slopes[is_narrow] = slopes.max()
    return float(errors.max() + 2 * (slopes * errors[is_ground]).max())


def rises(corners: Numbers, ellipsoid: Ellipsoid) -> tuple[Numbers, Numbers]:
    """Return twice the areas of geocentric triangles: seen from above, and in space.

    The first are negative for triangles that face inwards.
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up = corners.mean(axis=1) / (1.0, 1.0, 1 - ellipsoid.e2)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    return (normals * up).sum(axis=1), np.linalg.norm(normals, axis=1)


def divided(mesh: MeshData, way: GlobeWay) -> MeshData:
    """Return a mesh whose edges are halved until the globe's curvature keeps to its share.

    The mesh is in the coordinates of its CRS, without walls. The share is its attribute
    ``curvature``; a mesh without it is not changed. New vertices lie on the mesh's own triangles,
    so its error does not change. A budget of triangles may end the division.
    """
    share: CurvatureShare | None = mesh.attributes.get("curvature")
    if share is None:
        return mesh
    found = _Bends(mesh, way)
    worst = found.of_triangles.max(axis=1)
    largest = way.place.globe_ellipsoid.axis * _LONGEST**2 / 8
    wanted = share.error * way.per_unit * way.of_edges
    if not wanted and share.cell is not None:
        wanted = _bend_of(share.cell, way)
    limit = min(max(wanted, _least_limit(worst)), largest)
    if (worst <= limit).all():
        return mesh
    if share.max_triangles is None:
        return found.halved(limit)
    # The first try is the limit itself.
    best, low, high = mesh, limit, float(worst.max())
    for _ in range(_BUDGET_STEPS):
        tried = found.halved(limit)
        if tried.n_triangles <= share.max_triangles:
            best, high = tried, limit
        else:
            low = limit
        if high <= low * _BUDGET_RATIO:
            break
        limit = float(np.sqrt(low * high))
    return best


def least_share(mesh: MeshData, way: GlobeWay) -> float:
    """Return the smallest error, in the file's unit, that division can reach.

    Smaller ones would add more than `_MOST_ADDED` triangles.
    """
    worst = _Bends(mesh, way).of_triangles.max(axis=1)
    return _least_limit(worst) / way.of_edges / way.per_unit


def share_of_edge(ends: Numbers, way: GlobeWay) -> float:
    """Return the error, in the file's unit, for which an edge between two points is not divided."""
    return _bend_of(ends, way) / way.of_edges / way.per_unit


def _bend_of(ends: Numbers, way: GlobeWay) -> float:
    on_globe = way.geocentric(np.concatenate([ends, ends.mean(axis=0, keepdims=True)]))
    return float(np.linalg.norm(on_globe[2] - on_globe[:2].mean(axis=0)))


def _least_limit(worst: Numbers) -> float:
    # A triangle becomes about as many as its largest m contains limits.
    return float(worst.sum()) / _MOST_ADDED


class _Bends:
    """Vertices of a mesh on the globe, and m of its edges in metres.

    `of_triangles` has m of the sides of each triangle; side k leads from corner k to the next one.
    """

    def __init__(self, mesh: MeshData, way: GlobeWay) -> None:
        self._mesh, self._way = mesh, way
        self.on_globe = way.geocentric(mesh.points)
        _, number, _, _, bends = self._edges(mesh.triangles, mesh.vertices, self.on_globe)
        self.of_triangles = bends[number]

    def _edges(
        self, triangles: NDArray[np.int32], vertices: Numbers, on_globe: Numbers
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Numbers, Numbers, Numbers]:
        """Return the edges, the edge of each side, their middles, these on the globe, and m."""
        sides = np.stack([triangles, triangles[:, [1, 2, 0]]], axis=2).astype(np.int64)
        sides.sort(axis=2)
        keys = sides[..., 0] * len(vertices) + sides[..., 1]
        unique, number = np.unique(keys.ravel(), return_inverse=True)
        edges = np.stack([unique // len(vertices), unique % len(vertices)], axis=1)
        middles = (vertices[edges[:, 0]] + vertices[edges[:, 1]]) / 2
        placed = self._way.geocentric(middles + np.asarray(self._mesh.origin))
        bends = np.linalg.norm(placed - (on_globe[edges[:, 0]] + on_globe[edges[:, 1]]) / 2, axis=1)
        return edges, number.reshape(-1, 3), middles, placed, bends

    def halved(self, limit: float) -> MeshData:
        """Return the mesh with all m within a limit: longer edges are halved repeatedly."""
        mesh = self._mesh
        vertices, on_globe = mesh.vertices, self.on_globe
        is_long = (self.of_triangles > limit).any(axis=1)
        done, open_ = [mesh.triangles[~is_long]], mesh.triangles[is_long]
        while len(open_):
            _, number, middles, placed, bends = self._edges(open_, vertices, on_globe)
            long = np.flatnonzero(bends > limit)
            middle_of = np.full(len(bends), _NONE, dtype=np.int32)
            middle_of[long] = len(vertices) + np.arange(len(long))
            vertices = np.concatenate([vertices, middles[long]])
            on_globe = np.concatenate([on_globe, placed[long]])
            of_sides = middle_of[number]
            is_done = (of_sides == _NONE).all(axis=1)
            done.append(open_[is_done])
            open_ = _parts(open_[~is_done], of_sides[~is_done])
        return replace(mesh, vertices=vertices, triangles=np.concatenate(done))


def _parts(triangles: NDArray[np.int32], middles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the parts of triangles; each side has a middle, or `_NONE`."""
    n_middles = (middles != _NONE).sum(axis=1)
    found = []
    # Rotated so that the side that differs from the others is the first one.
    for n, differs in ((1, True), (2, False)):
        rows = np.flatnonzero(n_middles == n)
        first = np.argmax((middles[rows] != _NONE) == differs, axis=1)
        turned = (first[:, None] + np.arange(3)) % 3
        (a, b, c), (p, q, r) = triangles[rows[:, None], turned].T, middles[rows[:, None], turned].T
        if n == 1:
            found += [(a, p, c), (p, b, c)]
        else:
            found += [(q, c, r), (a, b, q), (a, q, r)]
    rows = np.flatnonzero(n_middles == 3)
    (a, b, c), (p, q, r) = triangles[rows].T, middles[rows].T
    found += [(a, p, r), (p, b, q), (q, c, r), (p, q, r)]
    return np.concatenate([np.stack(corners, axis=1) for corners in found])


def _worst_inside(m: Numbers) -> Numbers:
    """Return the largest 4 (a λ₂λ₃ + b λ₃λ₁ + c λ₁λ₂) over a triangle, for rows (a, b, c).

    In the interior, where its derivatives are equal; on an edge, if that point is outside.
    """
    low, middle, high = np.sort(m, axis=1).T
    below = 2 * (low * middle + middle * high + high * low) - (m**2).sum(axis=1)
    is_inside = high < low + middle
    inside = 4 * low * middle * high / np.where(is_inside, below, 1.0)
    return np.where(is_inside, np.maximum(inside, high), high)
