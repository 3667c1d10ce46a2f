"""Draw the pictures of the README and of the documentation: ``python -m tools.make_pictures DIR``.

DIR has the rasters named below. Views with the renderer, the meshes of all its modes, the shaded
mesh at three errors, the levels that it mixes, and how far it is from the raster go to docs/images.
"""

from pathlib import Path

import click
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.tri import LinearTriInterpolator, Triangulation
from PIL import Image, ImageDraw

import terrainwave
from benchmarks import common
from benchmarks.rasters import load_raster
from benchmarks.systems import TAU, camera_of
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.modes import MODES
from terrainwave.render.window.pictures import choose_camera, with_marks

SIZE, MODE_SIZE = (1200, 675), (400, 300)
# Picture: raster, bound, camera (the first view without), style, options of the scene
VIEWS: dict[str, tuple[str, float, str | None, Style, dict[str, float]]] = {
    "view-block": ("srtm3_swiss_alps_N46E008", 0, None, Style(), {}),
    "view-earth": ("etopo5_global_5arcmin", 0, None, Style(), {"exaggeration": 20.0}),
    "view-andes": ("srtm3_aconcagua_S33W071", 0, "-70.12,-32.93,7300,300,-16,50", Style(), {}),
    "view-moon": ("moon_gld100_apennines_256ppd", 2, "3.2,17.5,70000,20,-32,50", Style(
        coloring="ramp", sun=(290, 14), haze=0, background=(5, 6, 10)),
        {"radius": 1_737_400.0, "exaggeration": 1.5}),
    "view-hills": ("srtm1_bigtujunga", 0, "377500,3794500,2900,82,-15,46", Style(), {}),
}  # fmt: skip
MESHED = "srtm1_bigtujunga"
ERRORS, MAP_ERROR, LEVELS_ERROR = (3.0, 10.0, 30.0), 10.0, 120.0
LIGHT = np.array([-1.0, 1.0, 1.6]) / np.linalg.norm([-1.0, 1.0, 1.6])
WINDOW = (150, 250, 257, 385)
METRES_PER_DEGREE = 111_320.0


def draw_view(name: str, data: Path, folder: Path, out: Path) -> None:
    """Compress a raster and draw it."""
    raster, max_error, line, style, options = VIEWS[name]
    file = folder / f"{name}.twz"
    terrainwave.compress(data / f"{raster}.tif", file, max_error=max_error, verify=False)
    with terrainwave.open(file) as terrain, Canvas(terrain, SIZE, **options) as canvas:
        camera = choose_camera(canvas.scene.frame, canvas.viewport, line)
        image, frames = canvas.picture(camera, style)
        image = with_marks(canvas, image, frames, style, legend=not line, scale_bar=not line)
    Image.fromarray(image).save(out / f"{name}.jpg", quality=82)
    click.echo(f"{name}: {frames.n_triangles:,} triangles of {len(frames.nodes)} blocks")


def draw_modes(data: Path, folder: Path, out: Path) -> None:
    """Draw the meshes of all modes of the viewer from one camera, side by side."""
    (width, height), file = MODE_SIZE, folder / "modes.twz"
    terrainwave.compress(data / f"{MESHED}.tif", file, max_error=1, verify=False, overwrite=True)
    n_cols = -(-len(MODES) // 2)
    sheet = Image.new("RGB", (n_cols * width, 2 * height))
    style = Style(wireframe=True, haze=0, background=(16, 18, 22))
    for k, mode in enumerate(MODES):
        with terrainwave.open(file) as terrain, Canvas(terrain, MODE_SIZE, mode=mode) as view:
            pixels, frames = view.picture(camera_of("slope", view), style, max_pixel_error=TAU)
        picture, label = Image.fromarray(pixels), f"{mode}: {frames.n_triangles:,}"
        ImageDraw.Draw(picture).text((8, 6), label, fill=(255, 255, 255))
        sheet.paste(picture, (k % n_cols * width, k // n_cols * height))
    sheet.save(out / "systems-modes.jpg", quality=48, optimize=True)


def draw_mesh(axes, terrain: terrainwave.Terrain, mesh: terrainwave.Mesh, note: str = "") -> None:
    """Draw a mesh from above, x and y in metres; degrees are guessed by their size."""
    left, bottom, right, top = terrain.bounds
    scale = np.ones(3)
    if max(abs(left), abs(right)) <= 360:
        scale[:2] = METRES_PER_DEGREE
        scale[0] *= np.cos(np.radians((bottom + top) / 2))
    corners = (mesh.vertices * scale)[mesh.triangles]
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    flat = corners[:, :, :2]
    faces = PolyCollection(flat, array=np.clip(normals @ LIGHT, 0, 1), cmap="gray")
    faces.set(clim=(0, 1), edgecolor="face", linewidth=0.2)
    axes.add_collection(faces)
    lines = np.concatenate([flat[:, [0, 1]], flat[:, [1, 2]], flat[:, [2, 0]]])
    axes.add_collection(LineCollection(lines, colors="#1f4e79", linewidths=0.25))
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(f"within {mesh.error:g} m: {mesh.n_triangles:,} triangles{note}")


def draw_errors(axes, terrain: terrainwave.Terrain, heights: np.ndarray) -> None:
    """Draw the distance of the mesh from the original at every sample of the window."""
    row, col, n_rows, n_cols = WINDOW
    mesh = terrain.mesh(WINDOW, max_error=MAP_ERROR, optimise=1)
    rows, cols = np.mgrid[row : row + n_rows, col : col + n_cols]
    a, b, c, d, e, f = terrain.transform[:6]
    x = a * (cols + 0.5) + b * (rows + 0.5) + c - mesh.origin[0]
    y = d * (cols + 0.5) + e * (rows + 0.5) + f - mesh.origin[1]
    surface = Triangulation(*mesh.vertices[:, :2].T, mesh.triangles)
    found = LinearTriInterpolator(surface, mesh.vertices[:, 2])(x, y)
    apart = found - heights[rows, cols]
    image = axes.imshow(apart, cmap="PuOr", vmin=-MAP_ERROR, vmax=MAP_ERROR)
    axes.set_title(f"mesh - original, m; bound {mesh.error:g}, largest {np.abs(apart).max():.3f}")
    axes.set_axis_off()
    axes.figure.colorbar(image, ax=axes, shrink=0.8)


def draw_meshes(data: Path, folder: Path, out: Path) -> None:
    """Draw the three pictures of meshes."""
    source, file = data / f"{MESHED}.tif", folder / "mesh.twz"
    terrainwave.compress(source, file, max_error=1)
    with terrainwave.open(file) as terrain:
        figures = {"mesh_errors": plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")}
        for axes, error in zip(figures["mesh_errors"][1], ERRORS, strict=True):
            draw_mesh(axes, terrain, terrain.mesh(WINDOW, max_error=error, optimise=1))
        figures["mesh_levels"] = plt.subplots(figsize=(12, 7), layout="constrained")
        levels = terrain.mesh(max_error=LEVELS_ERROR, optimise=0)
        draw_mesh(figures["mesh_levels"][1], terrain, levels, ", several levels")
        figures["mesh_error_map"] = plt.subplots(figsize=(9, 5), layout="constrained")
        heights = load_raster(source).heights.astype(np.float64)
        draw_errors(figures["mesh_error_map"][1], terrain, heights)
        for name, (figure, _) in figures.items():
            path = out / f"{name}.png"
            figure.savefig(path, dpi=80)
            Image.open(path).convert("RGB").quantize(160).save(path, optimize=True)


@common.command(base="docs/images")
@common.directory_argument
def main(directory: Path, folder: Path, out: Path) -> None:
    """Draw and write the pictures."""
    for name in VIEWS:
        draw_view(name, directory, folder, out)
    draw_meshes(directory, folder, out)
    draw_modes(directory, folder, out)


if __name__ == "__main__":
    main()
