"""Flat triangles on curved globes: their error has the curvature, and edges are divided for it.

Surfaces are measured along the normals of the ellipsoid, which PROJ gives.
"""

import json

import meshio
import numpy as np
import pyproj
import pytest
from click.testing import CliRunner
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.cli import main
from terrainwave.errors import InvalidArgumentError
from terrainwave.export import curvature
from terrainwave.export.curvature import divided
from terrainwave.export.frames import globe_way
from terrainwave.export.mesh_files import mesh_for_file
from terrainwave.mesh.mesh_data import MeshData

MARS = "+proj=longlat +R=3396190 +no_defs"
# Name: CRS, transform, shape, error to ask for.
CASES = {
    "30 km of UTM": ("EPSG:32633", Affine(600, 0, 5e5, 0, -600, 5e6), (51, 51), 1.0),
    "cells of 9 km": ("EPSG:4326", Affine(1 / 12, 0, 10, 0, -1 / 12, 45), (7, 7), 1.0),
    "degrees near the pole": ("EPSG:4326", Affine(1, 0, 10, 0, -0.1, 89.95), (7, 14), 8.0),
    "around the pole": ("EPSG:3413", Affine(9e3, 0, -1e5, 0, -9e3, 1e5), (22, 22), 3.0),
    "Mars": (MARS, Affine(0.25, 0, 40, 0, -0.25, 10), (12, 12), 4.0),
}


def raster(tmp_path, case, heights=None, **options):
    crs, matrix, shape, _ = CASES[case]
    if heights is None:
        heights = np.full(shape, 700, np.int16)
    write_geotiff(tmp_path / "dem.tif", heights, transform=matrix, crs=crs, units=("m",))
    options = {"max_error": 0, "method": "store", "block": 32, "verify": False} | options
    terrainwave.compress(tmp_path / "dem.tif", tmp_path / "dem.twz", **options)
    return tmp_path / "dem.twz"


def run(*words):
    result = CliRunner().invoke(main, [str(word) for word in words], prog_name="terrainwave")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def geocentric(case, x, y, heights):
    """Return geocentric coordinates of points in a case's CRS, by PROJ."""
    crs = pyproj.CRS.from_user_input(CASES[case][0])
    lon, lat = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(x, y)
    body = "+R=3396190" if case == "Mars" else "+ellps=WGS84"
    cart = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart {body}"
    )
    return np.stack(cart.transform(lon, lat, heights), axis=-1)


def worst_off(case, points, triangles, x, y, heights):
    """Return how far points of a surface are from a geocentric mesh, along their normals.

    A triangle has to meet the normal of each point.
    """
    there = geocentric(case, x, y, heights)
    normals = geocentric(case, x, y, heights + 1) - there
    found = np.full(len(x), np.inf)
    reach = np.linalg.norm(points[triangles] - np.roll(points[triangles], 1, axis=1), axis=2)
    for corners, longest in zip(points[triangles], reach.max(axis=1), strict=True):
        near = np.flatnonzero(((there - corners[0]) ** 2).sum(axis=1) < (1.5 * longest + 50) ** 2)
        matrix = np.empty((len(near), 3, 3))
        matrix[:, :, 0], matrix[:, :, 1] = corners[1] - corners[0], corners[2] - corners[0]
        matrix[:, :, 2] = -normals[near]
        at_b, at_c, up = np.linalg.solve(matrix, (there[near] - corners[0])[..., None])[..., 0].T
        is_in = (at_b > -1e-9) & (at_c > -1e-9) & (at_b + at_c < 1 + 1e-9)
        found[near[is_in]] = np.minimum(found[near[is_in]], np.abs(up[is_in]))
    return found.max()


def centres(matrix, rows, cols):
    """Return x and y of samples of a raster with its north upwards."""
    return matrix.c + matrix.a * (cols.ravel() + 0.5), matrix.f + matrix.e * (rows.ravel() + 0.5)


def between_samples(case, n=40):
    """Return x and y of points within a case's outermost samples, whose lines are no chords."""
    _, matrix, (n_rows, n_cols), _ = CASES[case]
    rows, cols = np.meshgrid(np.linspace(0.1, n_rows - 1.1, n), np.linspace(0.1, n_cols - 1.1, n))
    return centres(matrix, rows, cols)


def n_of_edges(triangles):
    """Return the edges of triangles, and to how many triangles each belongs."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


@pytest.mark.few(1)
@pytest.mark.parametrize("case", CASES)
def test_flat_ground_lies_within_the_error_everywhere_between_its_samples(tmp_path, case):
    max_error, target = CASES[case][3], tmp_path / "a.ply"
    saved = run(
        "mesh", raster(tmp_path, case), target, "--frame", "ecef", "--max-error", max_error,
        "--json",
    )  # fmt: skip
    mesh = meshio.read(target)
    x, y = between_samples(case)
    worst = worst_off(case, mesh.points, mesh.cells[0].data, x, y, np.full(len(x), 700.0))
    assert worst <= saved["error"] <= max_error
    # not much finer than it has to be: a halved edge is four times nearer, and what lies along
    # the ground counts too
    assert worst > saved["curvature"] / 8


@pytest.mark.few(2)
@pytest.mark.parametrize("case", CASES)
def test_samples_of_rough_ground_lie_within_the_error_on_the_globe(tmp_path, case):
    _, matrix, shape, max_error = CASES[case]
    heights = (terrain_like(*shape) / 10).astype(np.int16)
    target = tmp_path / "a.ply"
    saved = run(
        "mesh", raster(tmp_path, case, heights), target, "--frame", "ecef", "--max-error",
        2 * max_error, "--json",
    )  # fmt: skip
    mesh = meshio.read(target)
    rows, cols = np.mgrid[1 : shape[0] - 1, 1 : shape[1] - 1]
    x, y = centres(matrix, rows, cols)
    there = heights[1:-1, 1:-1].ravel().astype(float)
    worst = worst_off(case, mesh.points, mesh.cells[0].data, x, y, there)
    assert worst <= saved["error"] <= 2 * max_error


def test_cells_alone_are_divided_where_they_lie_too_low(tmp_path):
    path = raster(tmp_path, "cells of 9 km")
    saved = run("mesh", path, tmp_path / "a.ply", "--frame", "ecef", "--max-error", 1, "--json")
    assert saved["n_triangles"] > 6 * 6 * 8
    loose = run("mesh", path, tmp_path / "b.ply", "--frame", "ecef", "--max-error", 20, "--json")
    assert loose["n_triangles"] < 6 * 6 * 3


@pytest.mark.parametrize("suffix", [".glb", ".stl", ".obj", ".vtu", ".terrain"])
def test_files_of_all_formats_keep_to_the_error_with_curvature_and_rounding(tmp_path, suffix):
    path = raster(tmp_path, "30 km of UTM")
    frame = [] if suffix == ".terrain" else ["--frame", "ecef"]
    saved = run("mesh", path, tmp_path / f"a{suffix}", *frame, "--max-error", 0.5, "--json")
    assert 0.5 / 64 < saved["curvature"] <= saved["error"] <= 0.5
    assert saved["error"] >= saved["curvature"] + saved["rounding"]


@pytest.mark.few(1)
@pytest.mark.parametrize("max_error", [2, 5, 20, 50])
def test_steep_ground_of_large_cells_keeps_to_the_error(tmp_path, max_error):
    # Slivers of a mesh are steep, which adds several times the share of the curvature.
    rows, cols = np.mgrid[0:64, 0:80]
    heights = 2000 * np.sin(cols / 9) * np.cos(rows / 7)
    write_geotiff(
        tmp_path / "dem.tif", heights, transform=Affine(0.05, 0, 10, 0, -0.05, 70),
        crs="IAU_2015:30100", units=("m",),
    )  # fmt: skip
    terrainwave.compress(tmp_path / "dem.tif", tmp_path / "dem.twz", max_error=1)
    saved = run(
        "mesh", tmp_path / "dem.twz", tmp_path / "a.ply", "--frame", "ecef", "--max-error",
        max_error, "--json",
    )  # fmt: skip
    assert max_error / 2 < saved["error"] <= max_error


def test_edges_between_blocks_are_divided_alike(tmp_path):
    heights = terrain_like(51, 51).astype(np.int16) // 8
    heights[:, 20:] = 3
    path = raster(tmp_path, "30 km of UTM", heights)
    with terrainwave.open(path) as terrain:
        mesh = terrain.mesh(max_error=0.5)
        found = divided(mesh, globe_way(mesh))
    assert found.n_triangles > mesh.n_triangles
    edges, counts = n_of_edges(found.triangles)
    assert counts.max() == 2
    # what belongs to one triangle is the outline of the area
    left, bottom, right, top = mesh.bounds
    ends = found.points[edges[counts == 1], :2]
    on = np.isclose(ends[..., 0], left) | np.isclose(ends[..., 0], right)
    assert (on | np.isclose(ends[..., 1], bottom) | np.isclose(ends[..., 1], top)).all()
    # new vertices lie on the triangles that the mesh had: the surface is the same
    old, new = (
        (np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])[:, 2]).sum()
        for c in (part.vertices[part.triangles] for part in (mesh, found))
    )
    assert new == pytest.approx(old)


def test_tiles_beside_one_another_have_the_same_vertices_on_their_edge(tmp_path):
    heights = terrain_like(51, 51).astype(np.int16) // 8
    heights[:, 20:] = 3
    path = raster(tmp_path, "30 km of UTM", heights)
    lines = []
    for window in ("0,0,51,33", "0,32,51,19"):
        target = tmp_path / f"{window}.ply"
        run(
            "mesh", path, target, "--frame", "ecef", "--max-error", 0.5, "--window", window,
            "--json",
        )  # fmt: skip
        points = meshio.read(target).points
        to_utm = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:32633", always_xy=True)
        x = to_utm.transform(*points.T)[0]
        line = np.round(points[np.abs(x - (5e5 + 32.5 * 600)) < 1e-3], 4)
        lines.append(line[np.lexsort(line.T)])
    assert len(lines[0]) > 8
    np.testing.assert_array_equal(*lines)


def test_an_error_that_takes_too_many_triangles_is_refused_with_one_that_does_not(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(curvature, "_MOST_ADDED", 1000)
    with terrainwave.open(raster(tmp_path, "30 km of UTM")) as terrain:

        def made(max_error):
            return mesh_for_file(
                lambda error: terrain.mesh(max_error=error), tmp_path / "a.ply", max_error,
                terrain.quanta_error, frame="ecef",
            )  # fmt: skip

        with pytest.raises(InvalidArgumentError, match="found max_error 0, expected") as refused:
            made(0.0)
        smallest = float(str(refused.value).split("at least ")[1].split()[0])
        assert 0 < smallest < 33
        mesh, is_within = made(smallest)
        assert is_within
        assert divided(mesh, globe_way(mesh)).n_triangles < 4000


@pytest.mark.few(1)
@pytest.mark.parametrize("case", ["30 km of UTM", "cells of 9 km", "Mars"])
@pytest.mark.parametrize("slope", [0, 0.1, 20])
def test_the_error_that_a_refusal_names_is_taken_and_near_the_smallest_that_is(
    tmp_path, monkeypatch, case, slope
):
    monkeypatch.setattr(curvature, "_MOST_ADDED", 500)
    heights = (slope * terrain_like(*CASES[case][2])).astype(np.int16)
    with terrainwave.open(raster(tmp_path, case, heights)) as terrain:

        def refused(max_error):
            """Return the error that is named instead; None if a mesh keeps to the given one."""
            try:
                _, is_within = mesh_for_file(
                    lambda error: terrain.mesh(max_error=error), tmp_path / "a.ply", max_error,
                    terrain.quanta_error, frame="ecef",
                )  # fmt: skip
            except InvalidArgumentError as error:
                return float(str(error).split("at least ")[1].split()[0])
            assert is_within
            return None

        named = refused(0.0)
        assert refused(named) is None
        assert refused(named / 2) is not None
        assert refused(refused(named / 4)) is None


def test_no_point_of_a_triangle_is_further_off_than_its_edges_say():
    rng = np.random.default_rng(5)
    weights = np.concatenate([np.eye(3), (1 - np.eye(3)) / 2, rng.dirichlet([1, 1, 1], 200)])
    for crs, centre, size in [
        ("EPSG:4326", (10, 0), 3), ("EPSG:4326", (10, 89), 1), ("EPSG:32633", (1e6, 8e6), 1e5),
        ("EPSG:3413", (0, 0), 3e5), ("EPSG:3857", (0, 1.2e7), 3e5), ("EPSG:2056", (3e6, 1e6), 1e5),
        ("ESRI:54030", (1e7, 5e6), 1e5),
    ]:  # fmt: skip
        points = np.zeros((300, 3, 3))
        shapes = rng.choice([1, 0.1], (300, 1, 2))
        points[..., :2] = centre + (rng.random((300, 3, 2)) - 0.5) * size * shapes
        points[..., 2] = rng.random((300, 3)) * 3000
        numbers = np.arange(900, dtype=np.int32).reshape(-1, 3)
        mesh = MeshData(points.reshape(-1, 3), numbers, (0.0, 0.0, 0.0), 0.0, crs)
        way = globe_way(mesh)
        bends = curvature._Bends(mesh, way)
        stated = curvature._worst_inside(bends.of_triangles)
        for triangle, number, most in zip(points, numbers, stated, strict=True):
            flat = weights @ bends.on_globe[number]
            off = np.linalg.norm(way.geocentric(weights @ triangle) - flat, axis=1)
            assert off.max() <= 9 / 8 * most + 1e-8


def test_a_budget_of_triangles_holds_and_is_used_against_the_curvature(tmp_path):
    path = raster(tmp_path, "30 km of UTM")
    errors = []
    for most in (100, 3000):
        saved = run(
            "mesh", path, tmp_path / f"{most}.ply", "--frame", "ecef", "--max-triangles", most,
            "--json",
        )  # fmt: skip
        assert most / 5 < saved["n_triangles"] <= most
        errors.append(saved["error"])
    assert errors[1] < errors[0] / 8 < 33 / 8
