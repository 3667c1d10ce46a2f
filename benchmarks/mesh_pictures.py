"""Draw the meshes of the documentation: ``python -m benchmarks.mesh_pictures DEM.tif``.

Three pictures into docs/images: the shaded mesh with its edges at three errors, the levels that
`Terrain.mesh` mixes, and how far the mesh is from the raster.

Exit status: 0 good; 2 wrong usage.
"""

import sys
import tempfile
from pathlib import Path

import click
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.tri import LinearTriInterpolator, Triangulation

import terrainwave

ERRORS = (3.0, 10.0, 30.0)
LIGHT = np.array([-1.0, 1.0, 1.6]) / np.linalg.norm([-1.0, 1.0, 1.6])
WINDOW = (150, 250, 257, 385)


def shades(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the brightness of every triangle, lit from the upper left."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.clip(normals @ LIGHT, 0, 1)


def draw(axes, mesh: terrainwave.Mesh, metres: np.ndarray, edges: bool = True) -> None:
    """Draw a mesh from above; `metres` scales x and y to the unit of heights."""
    points = mesh.vertices * [*metres, 1.0]
    corners = points[mesh.triangles][:, :, :2]
    faces = PolyCollection(corners, array=shades(points, mesh.triangles), cmap="gray")
    faces.set_clim(0, 1)
    faces.set_edgecolor("face")
    faces.set_linewidth(0.2)
    axes.add_collection(faces)
    if edges:
        lines = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        axes.add_collection(LineCollection(lines, colors="#1f4e79", linewidths=0.25))
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.set_axis_off()


def metres_per_unit(terrain: terrainwave.Terrain) -> np.ndarray:
    """Return metres per unit of x and y: degrees are guessed by their size."""
    left, bottom, right, top = terrain.bounds
    if max(abs(left), abs(right)) > 360:
        return np.ones(2)
    degree = 111_320.0
    return np.array([degree * np.cos(np.radians((bottom + top) / 2)), degree])


def wireframes(terrain: terrainwave.Terrain, target: Path) -> None:
    """Draw a window's mesh at each of `ERRORS`."""
    metres = metres_per_unit(terrain)
    figure, all_axes = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    for axes, error in zip(all_axes, ERRORS, strict=True):
        mesh = terrain.mesh(WINDOW, max_error=error, optimise=1)
        draw(axes, mesh, metres)
        axes.set_title(f"within {error:g} m: {mesh.n_triangles:,} triangles")
    figure.savefig(target, dpi=80)


def levels(terrain: terrainwave.Terrain, target: Path, error: float) -> None:
    """Draw the whole terrain's mesh: the blocks of its levels show in the sizes of triangles."""
    metres = metres_per_unit(terrain)
    mesh = terrain.mesh(max_error=error)
    figure, axes = plt.subplots(figsize=(12, 7), layout="constrained")
    draw(axes, mesh, metres)
    axes.set_title(f"within {error:g} m: {mesh.n_triangles:,} triangles, several levels")
    figure.savefig(target, dpi=80)


def error_map(terrain: terrainwave.Terrain, heights: np.ndarray, target: Path) -> None:
    """Draw the distance of the mesh from the original at every sample of the window."""
    row, col, n_rows, n_cols = WINDOW
    mesh = terrain.mesh(WINDOW, max_error=ERRORS[1], optimise=1)
    a, b, c, d, e, f = terrain.transform()
    rows, cols = np.mgrid[row : row + n_rows, col : col + n_cols] + 0.5
    x, y = a * cols + b * rows + c - mesh.origin[0], d * cols + e * rows + f - mesh.origin[1]
    surface = Triangulation(*mesh.vertices[:, :2].T, mesh.triangles)
    found = LinearTriInterpolator(surface, mesh.vertices[:, 2])(x, y)
    apart = found - heights[row : row + n_rows, col : col + n_cols]
    figure, axes = plt.subplots(figsize=(9, 5), layout="constrained")
    image = axes.imshow(apart, cmap="PuOr", vmin=-ERRORS[1], vmax=ERRORS[1])
    axes.set_title(f"mesh - original, m; bound {mesh.error:g}, largest {np.abs(apart).max():.3f}")
    axes.set_axis_off()
    figure.colorbar(image, ax=axes, shrink=0.8)
    figure.savefig(target, dpi=80)


@click.command(help=__doc__)
@click.argument("raster", type=click.Path(exists=True, path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), default="docs/images")
def main(raster: Path, out: Path) -> None:
    """Draw and write the pictures."""
    import rasterio

    with rasterio.open(raster) as dataset:
        heights = dataset.read(1).astype(np.float64)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "t.twz"
        terrainwave.compress(raster, path, max_error=1)
        with terrainwave.open(path) as terrain:
            wireframes(terrain, out / "mesh_errors.png")
            levels(terrain, out / "mesh_levels.png", 120.0)
            error_map(terrain, heights, out / "mesh_error_map.png")


if __name__ == "__main__":
    sys.exit(main())
