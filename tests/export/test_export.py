"""Meshes in files: what other programs read back, origins, rounding, whole files or none."""

import base64
import json
import re
from dataclasses import replace
from unittest.mock import Mock

import meshio
import numpy as np
import pytest
import trimesh
from pyproj import CRS
from quantized_mesh import metadata, read_tile
from tri.meshes import grid_mesh, hills

from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
    StorageError,
    TerrainwaveWarning,
)
from terrainwave.export.frames import areas, steepest, to_frame, vertex_normals
from terrainwave.export.mesh import Mesh
from terrainwave.export.mesh_files import save_mesh
from terrainwave.export.shapes import MESH_ENDINGS
from terrainwave.export.solid import border_edges, solidify

UTM = (30.0, 0.0, 400000.0, 0.0, -30.0, 4000000.0)
SECONDS = (1 / 3600, 0.0, 10.0, 0.0, -1 / 3600, 45.0)
# Heights are depths below the mean sea level.
DEPTHS = CRS("EPSG:32633+5715").to_wkt()
FORMATS = [name for name in MESH_ENDINGS if name != ".terrain"]
FLOATS = [".stl", ".glb", ".gltf"]


def utm_mesh(**options):
    return grid_mesh(hills(7, 9), UTM, crs="EPSG:32633", units="m", **options)


def read_back(path):
    """Return (points, triangles) with z upwards, by a reader that is not ours."""
    if path.suffix in (".ply", ".vtu", ".vtk"):
        found = meshio.read(path)
        return found.points, found.cells_dict["triangle"]
    found = trimesh.load(path, process=False, force="mesh")
    points = np.asarray(found.vertices)
    if path.suffix in (".glb", ".gltf"):
        points = points[:, [0, 2, 1]] * (1, -1, 1)
    return points, np.asarray(found.faces)


def corners(points, triangles):
    return points[triangles].reshape(-1, 9)


@pytest.mark.parametrize("frame", ["native", "local", "ecef"])
@pytest.mark.parametrize("suffix", FORMATS)
def test_triangles_come_back_in_order_and_sense(tmp_path, suffix, frame):
    mesh, path = utm_mesh(), tmp_path / f"area{suffix}"
    if frame != "native":
        mesh = grid_mesh(hills(7, 9), SECONDS, crs="EPSG:4326")
    saved = save_mesh(mesh, path, frame=frame)
    assert (saved.path, saved.n_bytes) == (str(path), path.stat().st_size)
    assert (saved.n_vertices, saved.n_triangles) == (63, 2 * 6 * 8)
    points, triangles = read_back(path)
    found = corners(points + np.asarray(saved.origin), triangles)
    expected = to_frame(mesh, frame)
    atol = 1e-3 if frame == "native" else 1e-4
    expected = corners(expected.points, expected.triangles)
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("suffix", MESH_ENDINGS)
def test_equal_meshes_give_equal_files(tmp_path, suffix):
    for name in ("one", "two"):
        save_mesh(utm_mesh(), tmp_path / f"{name}{suffix}")
    assert (tmp_path / f"one{suffix}").read_bytes() == (tmp_path / f"two{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", FLOATS)
def test_float32_formats_count_from_an_origin_and_reach_a_millimetre(tmp_path, suffix):
    mesh = utm_mesh()
    saved = save_mesh(mesh, tmp_path / f"area{suffix}")
    assert saved.origin == pytest.approx((400000 + 4.5 * 30, 4000000 - 3.5 * 30, 0))
    points, _ = read_back(tmp_path / f"area{suffix}")
    assert np.abs(points[:, :2]).max() == pytest.approx(4 * 30)
    assert saved.rounding < 1e-3


def about(path):
    """Return the JSON that the file carries."""
    if path.suffix == ".glb":
        found = trimesh.load(path, force="mesh").metadata["terrainwave"]
    elif path.suffix == ".gltf":
        found = json.loads(path.read_text())["meshes"][0]["extras"]["terrainwave"]
    else:
        (text,) = re.findall(rb"terrainwave (\{.*\})", path.read_bytes())
        found = json.loads(text)
    return found


@pytest.mark.parametrize("suffix", [name for name in FORMATS if name != ".stl"])
def test_file_tells_frame_origin_crs_and_error(tmp_path, suffix):
    saved = save_mesh(utm_mesh(), tmp_path / f"area{suffix}")
    found = about(tmp_path / f"area{suffix}")
    assert found["origin"] == list(saved.origin)
    assert found["frame"]["name"] == "native"
    assert found["crs"] == "EPSG:32633"
    assert found["error"] == saved.error
    assert found["error_unit"] == "m"


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_hostile_crs_cannot_add_lines_or_elements(tmp_path, suffix):
    mesh = utm_mesh(error=0.0)
    mesh = replace(mesh, crs=None, units="m\nelement vertex 5\n--><x> \u2028")
    path = tmp_path / f"area{suffix}"
    save_mesh(mesh, path)
    points, triangles = read_back(path)
    assert len(triangles) == mesh.n_triangles
    assert np.isfinite(points).all()


def test_gltf_looks_upwards_along_y(tmp_path):
    mesh = utm_mesh()
    save_mesh(mesh, tmp_path / "area.glb")
    found = np.asarray(trimesh.load(tmp_path / "area.glb", force="mesh").vertices)
    np.testing.assert_allclose(found[:, 1], mesh.points[:, 2], atol=1e-4)
    # north is away from the viewer: −z
    assert np.corrcoef(found[:, 2], mesh.points[:, 1])[0, 1] == pytest.approx(-1)


def attribute(path, name, n_columns):
    """Return the values of an attribute of a .gltf file's only mesh, float32."""
    about = json.loads(path.read_text())
    accessor = about["accessors"][about["meshes"][0]["primitives"][0]["attributes"][name]]
    view = about["bufferViews"][accessor["bufferView"]]
    data = base64.b64decode(about["buffers"][view["buffer"]]["uri"].partition(",")[2])
    assert accessor["componentType"] == 5126
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    values = np.frombuffer(data, "<f4", accessor["count"] * n_columns, start)
    return values.reshape(-1, n_columns)


def test_gltf_has_normals_and_places_in_a_picture(tmp_path):
    mesh = utm_mesh()
    save_mesh(mesh, tmp_path / "area.gltf")
    # Back to x east, y north, z up.
    normals = attribute(tmp_path / "area.gltf", "NORMAL", 3)[:, [0, 2, 1]] * (1, -1, 1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(normals, vertex_normals(mesh), atol=1e-4)
    assert (normals[:, 2] > 0).all()
    left, bottom, right, top = mesh.bounds
    uv = (mesh.points[:, :2] - (left, bottom)) / (right - left, top - bottom)
    # glTF counts v from the top of a picture.
    uv[:, 1] = 1 - uv[:, 1]
    np.testing.assert_allclose(attribute(tmp_path / "area.gltf", "TEXCOORD_0", 2), uv, atol=1e-6)


def numbers(path, word):
    """Return the numbers behind a word in a file of lines."""
    lines = [line.split() for line in path.read_text().splitlines()]
    return np.array([[float(part) for part in words] for w, *words in lines if w == word])


def test_places_in_a_picture_span_the_area_beyond_voids_at_its_edges(tmp_path):
    mesh = utm_mesh()
    left, bottom, right, top = mesh.bounds
    area = left - 60, bottom, right + 30, top + 90
    mesh = replace(mesh, attributes=mesh.attributes | {"area": area})
    save_mesh(mesh, tmp_path / "area.obj")
    found = numbers(tmp_path / "area.obj", "vt")
    width, height = area[2] - area[0], area[3] - area[1]
    assert found.min(axis=0) == pytest.approx([60 / width, 0], abs=1e-6)
    assert found.max(axis=0) == pytest.approx([1 - 30 / width, 1 - 90 / height], abs=1e-6)


@pytest.mark.parametrize("frame", ["native", "local"])
@pytest.mark.parametrize("suffix", [name for name in FORMATS if name not in (".glb", ".gltf")])
def test_y_points_upwards_where_it_is_asked_to(tmp_path, suffix, frame):
    mesh = utm_mesh()
    path = tmp_path / f"area{suffix}"
    saved = save_mesh(mesh, path, frame=frame, up="y")
    points, triangles = read_back(path)
    # (x, y, z) of the frame is (x, z, -y) in the file, and triangles keep their sense.
    back = points[:, [0, 2, 1]] * (1, -1, 1) + np.asarray(saved.origin)
    expected = to_frame(mesh, frame)
    np.testing.assert_allclose(
        corners(back, triangles), corners(expected.points, expected.triangles), rtol=0, atol=1e-3
    )
    if suffix == ".obj":
        normals = numbers(path, "vn")
        np.testing.assert_allclose(
            normals[:, [0, 2, 1]] * (1, -1, 1), vertex_normals(mesh), atol=1e-6
        )
    if suffix in (".obj", ".ply"):
        assert b'"up": "y"' in path.read_bytes()


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.glb", {"up": "z"}, "found up z for .glb, expected y"),
        ("a.obj", {"up": "y", "frame": "ecef"}, "geocentric coordinates"),
        ("a.ply", {"up": "x"}, "found up 'x', expected y or z"),
        ("a.terrain", {"up": "y"}, "frame of its own"),
        ("a.terrain", {"skirts": 1.0}, "frame of its own"),
        ("a.ply", {"skirts": 1.0, "solid": -9.0}, "found solid and skirts"),
        ("a.ply", {"skirts": 0.0}, "found skirts 0"),
    ],
)
def test_what_does_not_go_together_is_one_line(tmp_path, name, options, words):
    with pytest.raises(InvalidArgumentError, match=words):
        save_mesh(utm_mesh(), tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


def test_skirts_hang_from_every_border_and_face_outwards(tmp_path):
    mesh = grid_mesh(hills(9, 10), UTM, valid=voids(), crs="EPSG:32633", units="m")
    plain, skirted = tmp_path / "plain.obj", tmp_path / "skirted.obj"
    saved = save_mesh(mesh, skirted, skirts=25.0)
    save_mesh(mesh, plain)
    points = numbers(skirted, "v")
    lines = [line.split()[1:] for line in skirted.read_text().splitlines() if line[0] == "f"]
    triangles = np.array([[int(corner.split("/")[0]) - 1 for corner in line] for line in lines])
    n, n_triangles = mesh.n_vertices, mesh.n_triangles
    edges = border_edges(mesh.triangles)
    assert saved.n_triangles == n_triangles + 2 * len(edges)
    assert saved.error == mesh.error + saved.rounding
    lower = points[n:]
    upper = points[np.unique(edges)]
    assert lower[:, :2] == pytest.approx(upper[:, :2])
    assert upper[:, 2] - lower[:, 2] == pytest.approx(25)
    # Each border edge has a wall, whose two triangles use it the other way round.
    walls = triangles[n_triangles:]
    beside = {(int(b), int(a)) for a, b in edges.tolist()}
    assert {(int(a), int(b)) for a, b, _ in walls[: len(edges)].tolist()} == beside
    body = trimesh.Trimesh(points, triangles, process=False)
    assert body.is_winding_consistent
    # They are lit as the ground above them, and show its colour.
    for word in ("vn", "vt"):
        found = numbers(skirted, word)
        assert (found[:n] == numbers(plain, word)).all()
        assert (found[n:] == found[np.unique(edges)]).all()


def test_skirts_of_depths_hang_down_in_metres(tmp_path):
    depths = replace(utm_mesh(), crs=DEPTHS)
    with pytest.warns(TerrainwaveWarning, match="counts depths downwards"):
        save_mesh(depths, tmp_path / "a.ply", frame="local", skirts=25.0)
    points, _ = read_back(tmp_path / "a.ply")
    upper = points[np.unique(border_edges(depths.triangles))]
    assert upper[:, 2] - points[depths.n_vertices :, 2] == pytest.approx(25)


def surface_height(points, triangles, x, y):
    """Return the height of a surface at (x, y), by the barycentric coordinates of all triangles."""
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    at_b = (x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])
    at_c = (b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])
    at_b, at_c = at_b / area, at_c / area
    inside = (at_b >= -1e-12) & (at_c >= -1e-12) & (at_b + at_c <= 1 + 1e-12)
    index = np.flatnonzero(inside)[0]
    weights = np.array([1 - at_b[index] - at_c[index], at_b[index], at_c[index]])
    return float(weights @ points[triangles[index], 2])


@pytest.mark.parametrize("suffix", [".stl", ".obj"])
@pytest.mark.parametrize("z_scale", [1.0, 40.0])
def test_error_covers_what_rounding_did(tmp_path, suffix, z_scale):
    # A wide, steep mesh: a tenth of a metre is what float32 knows at 1000 km.
    mesh = grid_mesh(50 * hills(9, 9) + 1 / 3, (3e5, 0, 0, 0, -3e5, 0), error=0.0)
    path = tmp_path / f"area{suffix}"
    saved = save_mesh(mesh, path, frame="native", z_scale=z_scale)
    points, triangles = read_back(path)
    points = (points + np.asarray(saved.origin)) / (1, 1, z_scale)
    rng = np.random.default_rng(3)
    left, bottom, right, top = mesh.bounds
    for x, y in rng.uniform((left + 1, bottom + 1), (right - 1, top - 1), (200, 2)):
        there = surface_height(points, triangles, x, y)
        original = surface_height(mesh.points, mesh.triangles, x, y)
        assert abs(there - original) <= saved.rounding
    # Half a float32 step at 15000 is 2^-11, at 1.2e6 m 2^-4, times slopes of some 1/300.
    assert 0 < saved.rounding < 2e-3
    assert saved.error == saved.rounding


def of(mesh):
    return mesh.points, mesh.triangles


def test_triangles_below_float32_are_refused(tmp_path):
    mesh = grid_mesh(hills(3, 3), (1e-3, 0, 0, 0, -1e-3, 0))
    far = grid_mesh(hills(3, 3), (1e-3, 0, 1e6, 0, -1e-3, 1e6))
    both = Mesh(
        np.concatenate([mesh.points, far.points]),
        np.concatenate([mesh.triangles, far.triangles + 9]).astype(np.int32),
        (0.0, 0.0, 0.0),
        0.0,
    )
    with pytest.raises(InvalidHeightsError, match=r"\.ply, \.obj or \.vtu"):
        save_mesh(both, tmp_path / "area.stl")
    assert list(tmp_path.iterdir()) == []
    save_mesh(both, tmp_path / "area.ply")


@pytest.mark.parametrize("name", ["area.txt", "area", "area.tif", "ply"])
def test_an_unknown_extension_names_the_known_ones(tmp_path, name):
    with pytest.raises(InvalidHeightsError) as caught:
        save_mesh(utm_mesh(), tmp_path / name)
    assert all(known in str(caught.value) for known in MESH_ENDINGS)


@pytest.mark.parametrize("suffix", MESH_ENDINGS)
def test_an_existing_file_is_kept_without_overwrite(tmp_path, suffix):
    path = tmp_path / f"area{suffix}"
    path.write_bytes(b"mine")
    with pytest.raises(StorageError, match="already exists"):
        save_mesh(utm_mesh(), path)
    assert path.read_bytes() == b"mine"
    save_mesh(utm_mesh(), path, overwrite=True)
    assert path.read_bytes() != b"mine"


def test_a_writer_that_fails_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("terrainwave.export.mesh_formats.write_ply", Mock(side_effect=MemoryError))
    with pytest.raises(MemoryError):
        save_mesh(utm_mesh(), tmp_path / "area.ply")
    assert list(tmp_path.iterdir()) == []


def voids():
    """Return validity of 9 x 10 samples: a hole, two holes that touch at a corner, a bay."""
    valid = np.ones((9, 10), dtype=bool)
    valid[4, 4] = False
    valid[6, 6] = False  # with the one above: cells around meet in one vertex
    valid[0, 7:9] = False
    return valid


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".glb", ".ply"])
@pytest.mark.parametrize("frame", ["native", "local"])
def test_solid_is_watertight_in_the_file(tmp_path, suffix, frame):
    mesh = grid_mesh(hills(9, 10), UTM, valid=voids(), crs="EPSG:32633")
    save_mesh(mesh, tmp_path / f"body{suffix}", frame=frame, solid=50.0)
    # As slicers do, trimesh merges vertices at equal places here.
    body = trimesh.load(tmp_path / f"body{suffix}", force="mesh")
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.volume > 0


def test_parts_that_touch_in_one_vertex_are_pulled_apart_a_little(tmp_path):
    valid = np.ones((5, 5), dtype=bool)
    valid[0, 3:] = valid[1, 4] = False
    valid[3:, 0] = valid[4, 1] = False
    valid[1, 3] = valid[3, 1] = True
    # Four cells meet in the middle sample; two of them, at opposite corners, are void.
    heights = hills(5, 5)
    mesh = grid_mesh(heights, (1.0, 0, 0, 0, -1.0, 0), valid=valid)
    touching = Mesh(
        mesh.vertices,
        mesh.triangles[[is_kept(mesh, triangle) for triangle in mesh.triangles]],
        mesh.origin,
        mesh.error,
    )
    body = solidify(touching, 0.0)
    assert 0 < body.attributes["solid"]["moved"] < 1e-3
    assert body.to_trimesh().is_watertight
    merged = trimesh.Trimesh(body.vertices, body.triangles, process=True)
    assert merged.is_watertight
    assert (areas(body)[: touching.n_triangles] > 0).all()
    # The vertex of the upper left part has moved into it, the other one into the other.
    cells = body.points[body.triangles[: touching.n_triangles], :2]
    is_joint = (np.abs(cells - (2.5, -2.5)) < 0.01).all(axis=2)
    is_upper_left = cells[:, :, 0].mean(axis=1) < 2.5
    assert (cells[is_upper_left][is_joint[is_upper_left]] @ (1, -1) < 5).all()
    assert (cells[~is_upper_left][is_joint[~is_upper_left]] @ (1, -1) > 5).all()
    saved = save_mesh(touching, tmp_path / "body.ply", frame="native", solid=0.0)
    assert saved.rounding == pytest.approx(
        body.attributes["solid"]["moved"] * sum(steepest(touching))
    )


def is_kept(mesh, triangle):
    """Say whether a triangle lies in the upper left or the lower right quarter around (2, 2)."""
    col, row = mesh.points[triangle, 0].mean() - 0.5, -mesh.points[triangle, 1].mean() - 0.5
    return (row < 2) == (col < 2)


@pytest.mark.parametrize("base", [101.0, 1e9])
def test_a_base_that_is_not_below_is_refused(tmp_path, base):
    mesh = grid_mesh(np.full((3, 3), 101.0), UTM)
    with pytest.raises(InvalidHeightsError, match="lowest height 101"):
        save_mesh(mesh, tmp_path / "body.stl", solid=base)


def test_to_trimesh_has_the_vertices_and_triangles():
    mesh = utm_mesh()
    found = mesh.to_trimesh()
    np.testing.assert_array_equal(found.vertices, mesh.vertices)
    np.testing.assert_array_equal(found.faces, mesh.triangles)


def test_to_pyvista_gives_the_surface():
    mesh = utm_mesh()
    surface = mesh.to_pyvista()
    np.testing.assert_array_equal(surface.points, mesh.vertices)
    np.testing.assert_array_equal(surface.regular_faces, mesh.triangles)
    # 6 x 8 cells of 30 m, seen from above.
    flat = surface.copy()
    flat.points[:, 2] = 0
    assert flat.area == pytest.approx(6 * 8 * 30**2)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4258"])
def test_tile_holds_the_surface_within_its_stated_error(tmp_path, crs):
    mesh = grid_mesh(hills(7, 9), SECONDS, crs=crs, error=0.0)
    saved = save_mesh(mesh, tmp_path / "area.terrain")
    header, u, v, h, triangles, _, extensions = read_tile((tmp_path / "area.terrain").read_bytes())
    west, south, east, north = metadata(extensions)["bounds"]
    assert (west, south, east, north) == pytest.approx(mesh.bounds, abs=1e-9)
    height = header["low"] + h / 32767 * (header["high"] - header["low"])
    points = np.stack(
        [west + u / 32767 * (east - west), south + v / 32767 * (north - south), height], axis=-1
    )
    rng = np.random.default_rng(5)
    for x, y in rng.uniform((west, south), (east, north), (200, 2)):
        x, y = np.clip((x, y), (west + 1e-7, south + 1e-7), (east - 1e-7, north - 1e-7))
        there = surface_height(points, triangles, x, y)
        assert abs(there - surface_height(mesh.points, mesh.triangles, x, y)) <= saved.error
    # Half a step of each axis, times the steepest slopes.
    steps = np.array([north - south, east - west, np.ptp(mesh.points[:, 2]) + 1e-3]) / 32767
    slopes = np.array([*steepest(mesh)[::-1], 1.0])
    assert 0 < saved.error - saved.curvature <= 0.5 * (steps @ slopes)
    assert triangles.max() == len(u) - 1


def test_tile_names_the_vertices_of_its_edges(tmp_path):
    save_mesh(grid_mesh(hills(7, 9), SECONDS, crs="EPSG:4326"), tmp_path / "area.terrain")
    _, u, v, _, _, (west, south, east, north), _ = read_tile(
        (tmp_path / "area.terrain").read_bytes()
    )
    assert [len(edge) for edge in (west, south, east, north)] == [7, 9, 7, 9]
    assert (u[west] == 0).all()
    assert (v[south] == 0).all()
    assert (u[east] == 32767).all()
    assert (v[north] == 32767).all()


def test_tile_lies_where_its_points_are(tmp_path):
    mesh = grid_mesh(hills(7, 9), SECONDS, crs="EPSG:4326", units="m")
    save_mesh(mesh, tmp_path / "area.terrain")
    header, *_ = read_tile((tmp_path / "area.terrain").read_bytes())
    points = to_frame(mesh, "ecef").points
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    assert [header["x"], header["y"], header["z"]] == pytest.approx(centre.tolist(), abs=1e-3)
    sphere = np.array([header["sx"], header["sy"], header["sz"]])
    assert np.linalg.norm(points - sphere, axis=1).max() <= header["radius"] + 1e-3


@pytest.mark.parametrize("wireframe", [False, True])
def test_plot_draws_every_triangle(wireframe):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    mesh = utm_mesh()
    ax = mesh.plot(wireframe=wireframe)
    (faces,) = ax.collections
    assert len(faces.get_paths()) == mesh.n_triangles
    ax.figure.canvas.draw()
    assert ax.get_xlim() == pytest.approx((mesh.bounds[0], mesh.bounds[2]))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("easting, m", "northing, m")
    _, bar = ax.figure.axes
    assert bar.get_ylabel() == f"height, {mesh.units or 'unit unknown'}"
    plt.close(ax.figure)
