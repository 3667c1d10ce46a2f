"""Levels of detail: errors that double and hold at every original, one origin, all or none."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.tri import LinearTriInterpolator, Triangulation
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import BoundViolationError, StorageError
from terrainwave.terrain import Terrain

# Rows go south by 30 m from the centre of the first pixel.
TRANSFORM = Affine(30, 0, 400000 - 15, 0, -30, 4000000 + 15)


def relief():
    """Return heights with rough and with level ground: coarse blocks beside fine ones."""
    heights = terrain_like(130, 170).astype(np.float32)
    heights[:, 90:] *= 0.05
    return heights


def with_voids():
    """Return the same, void along one edge of the raster and within."""
    heights = relief()
    heights[:, :7] = np.nan
    heights[40:50, 60:80] = np.nan
    return heights


def made(folder, heights, max_error=0.25):
    write_geotiff(folder / "dem.tif", heights, units=("m",), crs="EPSG:32611", transform=TRANSFORM)
    path = folder / "dem.twz"
    terrainwave.compress(folder / "dem.tif", path, max_error=max_error, block=32)
    return path


def extras(path):
    """Return what a .glb file says of its mesh."""
    data = Path(path).read_bytes()
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    return json.loads(text)["meshes"][0]["extras"]["terrainwave"]


def points_and_triangles(path):
    """Return what trimesh reads, x to the east, y to the north and z upwards, in the CRS."""
    found = trimesh.load(path, process=False, force="mesh")
    points = np.asarray(found.vertices, dtype=np.float64)
    points = points[:, [0, 2, 1]] * (1, -1, 1) + extras(path)["origin"]
    return points, np.asarray(found.faces)


def distances(path, heights):
    """Return how far samples are above the surface in a file; NaN where it has none."""
    points, triangles = points_and_triangles(path)
    rows, cols = np.mgrid[: heights.shape[0], : heights.shape[1]]
    surface = Triangulation((points[:, 0] - 4e5) / 30, (4e6 - points[:, 1]) / 30, triangles)
    found = LinearTriInterpolator(surface, points[:, 2])(cols, rows).filled(np.nan)
    return heights - found


@pytest.mark.few(1)
@pytest.mark.parametrize("heights", [relief(), with_voids()], ids=["whole", "voids"])
def test_every_original_is_within_the_error_that_each_file_states(tmp_path, heights):
    path = made(tmp_path, heights)
    saved = terrainwave.save_lods(path, tmp_path / "a.glb", 4, max_error=1)
    assert [Path(one.path).name for one in saved] == [f"a_lod{k}.glb" for k in range(4)]
    for number, one in enumerate(saved):
        assert one.error <= 2**number
        assert extras(one.path) | {"lod": number, "n_lods": 4, "error": one.error} == extras(
            one.path
        )
        apart = np.abs(distances(one.path, heights))
        assert np.isfinite(apart).sum() > 0.95 * np.isfinite(heights).sum()
        assert np.nanmax(apart) <= one.error + 1e-9
    counts = [one.n_triangles for one in saved]
    assert counts == sorted(counts, reverse=True)
    assert counts[3] < counts[0] / 4


def test_without_an_error_the_finest_has_that_of_the_stored_meshes(tmp_path):
    path = made(tmp_path, relief())
    saved = terrainwave.save_lods(path, tmp_path / "a.glb", 3)
    with terrainwave.open(path) as terrain:
        first = terrain.mesh()
    assert saved[0].n_triangles == first.n_triangles
    assert [one.error <= first.error * 2**k for k, one in enumerate(saved) if k] == [True, True]


def spoiled(monkeypatch, change):
    """Let meshes of more than 1 m be something else."""
    mesh = Terrain.mesh

    def wrong(self, *args, **options):
        found = mesh(self, *args, **options)
        return change(found) if options["max_error"] > 1 else found

    monkeypatch.setattr(Terrain, "mesh", wrong)


def moved(mesh):
    vertices = mesh.vertices.copy()
    vertices[len(vertices) // 2, 2] += 9
    return replace(mesh, vertices=vertices)


def torn(mesh):
    return replace(mesh, triangles=np.delete(mesh.triangles, mesh.n_triangles // 2, axis=0))


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("change", "words"),
    [(moved, "further from it than the stated error"), (torn, "covered in part")],
)
def test_a_mesh_that_is_not_what_it_states_is_found_before_a_file_is_written(
    tmp_path, monkeypatch, change, words
):
    path = made(tmp_path, relief())
    before = set(tmp_path.iterdir())
    spoiled(monkeypatch, change)
    with pytest.raises(BoundViolationError, match=f"LOD 1 is not what it states.*{words}"):
        terrainwave.save_lods(path, tmp_path / "a.glb", 2, max_error=1)
    assert set(tmp_path.iterdir()) == before


def test_no_file_is_written_where_one_of_them_exists(tmp_path):
    path = made(tmp_path, relief())
    (tmp_path / "a_lod1.glb").write_bytes(b"kept")
    with pytest.raises(StorageError, match=r"a_lod1\.glb already exists"):
        terrainwave.save_lods(path, tmp_path / "a.glb", 2, max_error=1)
    assert not (tmp_path / "a_lod0.glb").exists()
    assert (tmp_path / "a_lod1.glb").read_bytes() == b"kept"


def borders(one, other, axis):
    """Return the vertices of two meshes on the line where the first ends, as sets."""
    first, second = one.points, other.points
    # Rows go south.
    at = first[:, 0].max() if axis else first[:, 1].min()
    assert at == pytest.approx(second[:, 0].min() if axis else second[:, 1].max(), abs=1e-6)
    return [
        {tuple(np.round(p, 6)) for p in points[np.abs(points[:, 1 - axis] - at) < 1e-6]}
        for points in (first, second)
    ]


def tiles(at, axis, shape):
    """Return the windows on both sides of a row or column, which both have."""
    n_rows, n_cols = shape
    if axis:
        return (0, 0, n_rows, at + 1), (0, at, n_rows, n_cols - at)
    return (0, 0, at + 1, n_cols), (at, 0, n_rows - at, n_cols)


@pytest.mark.few(1)
@pytest.mark.parametrize("heights", [relief(), with_voids()], ids=["whole", "voids"])
@pytest.mark.parametrize("max_error", [None, 1, 4, 16, 64])
def test_edges_of_neighbouring_tiles_have_the_same_vertices(tmp_path, heights, max_error):
    """Blocks of several levels met there, of which each tile saw its own."""
    with terrainwave.open(made(tmp_path, heights)) as terrain:
        # Between blocks, next to one, and within some.
        for axis, at in ((1, 64), (1, 96), (1, 95), (1, 100), (0, 32), (0, 77)):
            meshes = [
                terrain.mesh(window, max_error=max_error)
                for window in tiles(at, axis, heights.shape)
            ]
            one, other = borders(*meshes, axis)
            assert one == other
            assert len(one) >= 2


def test_edges_through_blocks_beside_coarse_ones_have_the_same_vertices(tmp_path):
    """The block that both tiles cut had a coarse neighbour in one of them, which moved its mesh."""
    heights = terrain_like(130, 320).astype(np.float32)
    heights[:, 128:] *= 0.01
    with terrainwave.open(made(tmp_path, heights)) as terrain:
        for at in (108, 122):
            meshes = [terrain.mesh(w, max_error=8) for w in tiles(at, 1, heights.shape)]
            one, other = borders(*meshes, 1)
            assert one == other


def test_the_same_edges_match_in_files(tmp_path):
    path = made(tmp_path, relief())
    found = []
    for name, window in zip(("west", "east"), tiles(40, 1, (130, 170)), strict=True):
        terrainwave.save_lods(path, tmp_path / f"{name}.glb", 3, max_error=4, window=window)
    for number in range(3):
        for name in ("west", "east"):
            points, _ = points_and_triangles(tmp_path / f"{name}_lod{number}.glb")
            on_line = points[np.abs(points[:, 0] - (4e5 + 40 * 30)) < 1e-2]
            found.append(on_line[np.lexsort(on_line.T)])
        np.testing.assert_allclose(found[-1], found[-2], rtol=0, atol=1e-3)
    # Two levels of detail of one line are two lines: tiles beside one another need skirts then.
    assert len(found[0]) != len(found[-1])


def test_lossless_files_that_share_a_line_match_there_without_an_error(tmp_path):
    """Neighbour files: the stored meshes' edges follow from the heights of the line alone."""
    heights = relief().round()
    meshes = []
    for number, (row, col, n_rows, n_cols) in enumerate(tiles(100, 1, heights.shape)):
        transform = Affine(30, 0, TRANSFORM.c + 30 * col, 0, -30, TRANSFORM.f - 30 * row)
        part = heights[row : row + n_rows, col : col + n_cols]
        options = {"units": ("m",), "crs": "EPSG:32611", "transform": transform}
        write_geotiff(tmp_path / f"{number}.tif", part, **options)
        terrainwave.compress(
            tmp_path / f"{number}.tif", tmp_path / f"{number}.twz", max_error=0, block=32
        )
        with terrainwave.open(tmp_path / f"{number}.twz") as terrain:
            meshes.append(terrain.mesh())
    one, other = borders(*meshes, 1)
    assert one == other


def test_a_tile_has_few_triangles_more_than_its_share(tmp_path):
    """Blocks along its edges are those of the full grid, but no finer than the error needs."""
    heights = relief()
    with terrainwave.open(made(tmp_path, heights)) as terrain:
        whole = terrain.mesh(max_error=16).n_triangles
        parts = [
            terrain.mesh(window, max_error=16).n_triangles for window in tiles(96, 1, heights.shape)
        ]
    assert whole <= sum(parts) < 1.1 * whole + 100


def test_a_budget_of_a_window_needs_no_fine_blocks_along_its_edges(tmp_path):
    with terrainwave.open(made(tmp_path, relief())) as terrain:
        assert terrain.mesh((0, 90, 130, 60), max_triangles=24).n_triangles <= 24


@pytest.mark.few(1)
@pytest.mark.parametrize("frame", ["native", "local", "ecef"])
def test_all_have_one_origin_and_one_picture(tmp_path, frame):
    """Voids along an edge are another outline on each level, which moved the middle."""
    path = made(tmp_path, with_voids())
    saved = terrainwave.save_lods(path, tmp_path / "a.glb", 4, max_error=2, frame=frame)
    assert len({one.origin for one in saved}) == 1
    about = [extras(one.path) for one in saved]
    assert len({tuple(one["frame"].get("centre", ())) for one in about}) == 1
    # Between the centres of the outermost pixels, voids or not.
    bounds = [400000.0, 4000000 - 129 * 30, 400000 + 169 * 30, 4000000.0]
    assert [one["texture_bounds"] for one in about] == [bounds] * 4
