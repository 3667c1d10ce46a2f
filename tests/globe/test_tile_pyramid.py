"""Pyramids of Cesium tiles: edges that agree, errors that hold, all of the globe."""

import json

import numpy as np
import pytest
from commands import run
from quantized_mesh import metadata, read_tile
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.warp import transform
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import InvalidHeightsError
from terrainwave.globe.cesium import TilePyramid, write_tiles

CELLS = 16
UTM = Affine(200.0, 0.0, 4e5, 0.0, -200.0, 4e6)
GLOBAL = Affine(22.5, 0.0, -180.0, 0.0, -22.5, 90.0)


def open_terrain(tmp_path, heights, transform, crs, **options):
    units = options.pop("units", ("m",))
    mask = options.pop("mask", None)
    raster = write_geotiff(
        tmp_path / "dem.tif", heights, transform=transform, crs=crs, units=units, mask=mask
    )
    options = {"max_error": 0, "method": "store", "block": 32, "verify": False} | options
    terrainwave.compress(raster, tmp_path / "dem.twz", overwrite=True, **options)
    return terrainwave.open(tmp_path / "dem.twz", threads=1)


def steep(n_rows, n_cols):
    return terrain_like(n_rows, n_cols) * 5


def surface(tile):
    """Return (points in longitude, latitude and metres, triangles, metadata) of a tile's bytes."""
    header, u, v, h, triangles, _, extensions = read_tile(tile.data)
    about = metadata(extensions)
    west, south, east, north = about["bounds"]
    points = np.stack(
        [
            west + u / 32767 * (east - west),
            south + v / 32767 * (north - south),
            header["low"] + h / 32767 * (header["high"] - header["low"]),
        ],
        axis=1,
    )
    return points, triangles, about


def areas_in_steps(tile):
    _, u, v, _, triangles, _, _ = read_tile(tile.data)
    a, b, c = (np.stack([u, v], 1)[triangles[:, k]] for k in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def heights_at(points, triangles, lon, lat):
    """Return the heights of a surface at places, NaN outside, by all triangles' barycentrics."""
    found = np.full(len(lon), np.nan)
    for triangle in triangles:
        a, b, c = points[triangle]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        at_b = ((lon - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (lat - a[1])) / area
        at_c = ((b[0] - a[0]) * (lat - a[1]) - (lon - a[0]) * (b[1] - a[1])) / area
        inside = (at_b >= -1e-9) & (at_c >= -1e-9) & (at_b + at_c <= 1 + 1e-9)
        height = a[2] + at_b * (b[2] - a[2]) + at_c * (c[2] - a[2])
        found[inside] = height[inside]
    return found


def edge(tile, side):
    """Return {position along the side: height} of the vertices in the tile's list of an edge."""
    header, u, v, h, _, edges, _ = read_tile(tile.data)
    at = edges[("west", "south", "east", "north").index(side)]
    along = v if side in ("west", "east") else u
    height = header["low"] + h / 32767 * (header["high"] - header["low"])
    return dict(zip(along[at].tolist(), height[at].tolist(), strict=True))


def assert_edges_agree(pyramid, zoom, pairs):
    for (x, y), (other_x, other_y), side, facing in pairs:
        here = edge(pyramid.tile(zoom, x, y), side)
        there = edge(pyramid.tile(zoom, other_x, other_y), facing)
        assert here.keys() == there.keys()
        assert len(here) >= 2
        # The tiles' ranges of heights differ; what they hold of the edge does not.
        assert list(here.values()) == pytest.approx([there[k] for k in here], abs=1e-9, rel=0)


def test_tile_covers_its_square_once(tmp_path):
    with open_terrain(tmp_path, steep(40, 40), UTM, "EPSG:32633") as terrain:
        pyramid = TilePyramid(terrain, cells=CELLS)
        for zoom in range(pyramid.max_zoom + 1):
            found = pyramid.available(zoom)[0]
            twice = areas_in_steps(pyramid.tile(zoom, found.first_x, found.first_y))
            assert (twice > 0).all()
            assert twice.sum() == 2 * 32767**2


def test_tiles_of_a_projected_raster_have_the_same_vertices_on_shared_edges(tmp_path):
    with open_terrain(tmp_path, steep(40, 40), UTM, "EPSG:32633") as terrain:
        pyramid = TilePyramid(terrain, cells=CELLS)
        zoom = pyramid.max_zoom
        (found,) = pyramid.available(zoom)
        x, y = found.first_x, found.first_y
        assert found.last_x > x
        assert found.last_y > y
        pairs = [((x, y), (x + 1, y), "east", "west"), ((x, y), (x, y + 1), "north", "south")]
        assert_edges_agree(pyramid, zoom, pairs)


def test_tiles_agree_across_the_antimeridian_and_on_poles(tmp_path):
    heights = terrain_like(8, 16) * 40
    with open_terrain(tmp_path, heights, GLOBAL, "EPSG:4326") as terrain:
        pyramid = TilePyramid(terrain, cells=4)
        zoom, last = 1, 3
        assert_edges_agree(pyramid, zoom, [((last, 1), (0, 1), "east", "west")])
        tops = [edge(pyramid.tile(zoom, x, 1), "north") for x in range(4)]
        # The mean of the first row, which all longitudes meet in: bilinear, so that of its samples.
        mean = heights[0].mean()
        found = {height for top in tops for height in top.values()}
        assert len(found) == 1
        assert found.pop() == pytest.approx(mean, abs=pyramid._heights.edge_step(zoom) / 256)


def test_longitudes_may_count_from_0_or_from_minus_180(tmp_path):
    heights = terrain_like(8, 16) * 40
    with open_terrain(tmp_path, heights, GLOBAL, "EPSG:4326") as terrain:
        pyramid = TilePyramid(terrain, cells=4)
        expected = [pyramid.tile(1, x, y).data for x in range(4) for y in range(2)]
    turned = Affine(22.5, 0.0, 0.0, 0.0, -22.5, 90.0)
    with open_terrain(tmp_path, np.roll(heights, 8, axis=1), turned, "EPSG:4326") as terrain:
        pyramid = TilePyramid(terrain, cells=4)
        assert pyramid.extent == (-180, -90, 180, 90)
        assert [pyramid.tile(1, x, y).data for x in range(4) for y in range(2)] == expected


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("matrix", "crs"),
    [
        (UTM, "EPSG:32633"),
        (Affine(1 / 600, 0, 10, 0, -1 / 600, 46), "EPSG:4326"),
        (Affine(1 / 600, 0, 10, 0, 1 / 600, 46), "EPSG:4258"),
        (Affine(150, 60, 4e5, 60, -150, 4e6), "EPSG:32633"),
    ],
)
def test_no_sample_is_further_from_its_tile_than_stated(tmp_path, matrix, crs):
    heights = steep(33, 37)
    with open_terrain(tmp_path, heights, matrix, crs) as terrain:
        pyramid = TilePyramid(terrain, cells=CELLS)
        zoom = pyramid.max_zoom
        # Triangles at the raster's edge have corners outside it, at the height of voids.
        inner = heights[2:-2, 2:-2]
        places = [matrix @ (col + 2.5, row + 2.5) for row, col in np.ndindex(inner.shape)]
        x, y = np.array(places).T
        lon, lat = (np.array(v) for v in transform(CRS.from_string(crs), "EPSG:4326", x, y))
        n_seen, largest = 0, 0.0
        for found in pyramid.available(zoom):
            for place in found.tiles():
                tile = pyramid.tile(zoom, *place)
                if tile.surface_error is None:
                    continue
                points, triangles, about = surface(tile)
                assert about["surfaceerror"] == tile.surface_error
                assert about["geometricerror"] == tile.surface_error + terrain.effective_error
                west, south, east, north = about["bounds"]
                inside = (lon >= west) & (lon <= east) & (lat >= south) & (lat <= north)
                there = heights_at(points, triangles, lon[inside], lat[inside])
                apart = np.abs(there - inner.ravel()[inside])
                n_seen += np.count_nonzero(inside)
                largest = max(largest, apart.max(initial=0) / tile.surface_error)
        assert n_seen >= inner.size
        assert 0.7 < largest <= 1 + 1e-6


def test_coarse_tiles_add_what_their_level_is_from_the_originals(tmp_path):
    with open_terrain(tmp_path, steep(70, 70), UTM, "EPSG:32633") as terrain:
        pyramid = TilePyramid(terrain, cells=CELLS)
        zoom = pyramid.max_zoom - 2
        (found,) = pyramid.available(zoom)
        tile = next(
            tile
            for place in found.tiles()
            if (tile := pyramid.tile(zoom, *place)).error is not None
        )
        level = pyramid.globe.level_for(pyramid.cell_size(zoom))
        assert level < terrain.n_levels - 1
        errors = [terrain.block_error(block) for block in terrain.grid.blocks(level)]
        assert (tile.error - tile.surface_error) == pytest.approx(max(errors))
        assert tile.error > tile.surface_error


VOID = np.ones((24, 24), dtype=bool)
VOID[8:16, 8:16] = False
# Of the tile that a raster of 24 x 24 fills.
SIZE = 180 / 2**9
ONE_TILE = Affine(SIZE / 24, 0, 0, 0, -SIZE / 24, SIZE)


def test_voids_are_holes_and_the_globe_goes_on_around_the_raster(tmp_path):
    heights = np.full((24, 24), 1000, dtype=np.int16)
    half = ONE_TILE @ Affine.scale(0.5)  # a quarter of the tile
    for matrix, beyond in ((ONE_TILE, 1000), (half, -50)):
        with open_terrain(tmp_path, heights, matrix, "EPSG:4326", mask=VOID) as terrain:
            pyramid = TilePyramid(terrain, void_height=-50, cells=32)
            tile = pyramid.tile(9, 512, 256)
        points, triangles, about = surface(tile)
        assert (areas_in_steps(tile) > 0).all()
        cols, rows = np.array([4.5, 12.0, 20.0]), np.array([4.5, 12.0, 4.5])
        x, y = matrix @ (cols, rows)
        near = {"abs": pyramid.tolerance(9), "nan_ok": True}
        found = heights_at(points, triangles, x, y)
        assert found == pytest.approx([1000, np.nan, 1000], **near)
        # What is drawn ends within a cell of the last valid sample.
        x, y = matrix @ (np.full(2, 12.0), np.array([7.5 + 0.8, 7.5 - 0.8]))
        assert heights_at(points, triangles, x, y) == pytest.approx([np.nan, 1000], **near)
        outside = heights_at(points, triangles, np.array([0.9 * SIZE]), np.array([0.1 * SIZE]))
        assert outside[0] == pytest.approx(beyond, abs=1)
        assert about["surfaceerror"] <= pyramid.tolerance(9)


def test_tiles_beside_one_another_agree_about_a_hole(tmp_path):
    heights = steep(40, 40)
    mask = np.ones((40, 40), dtype=bool)
    mask[5:30, 8:33] = False
    with open_terrain(tmp_path, heights, UTM, "EPSG:32633", mask=mask) as terrain:
        pyramid = TilePyramid(terrain, cells=CELLS)
        zoom = pyramid.max_zoom
        (found,) = pyramid.available(zoom)
        pairs = [((x, y), (x + 1, y), "east", "west") for x, y in found.tiles() if x < found.last_x]
        pairs += [
            ((x, y), (x, y + 1), "north", "south") for x, y in found.tiles() if y < found.last_y
        ]
        n_holes = 0
        for (x, y), (other_x, other_y), side, facing in pairs:
            here = edge(pyramid.tile(zoom, x, y), side)
            there = edge(pyramid.tile(zoom, other_x, other_y), facing)
            # A vertex at a hole's rim may have all of its triangles on one side.
            both = here.keys() & there.keys()
            assert len(here.keys() ^ there.keys()) <= 4
            assert [here[k] for k in both] == pytest.approx([there[k] for k in both], abs=1e-9)
            n_holes += bool(both) and max(np.diff(sorted(here)), default=0) > 32767 / CELLS
        assert n_holes


def test_voids_have_the_height_asked_for_and_no_share_in_the_error(tmp_path):
    heights = np.full((24, 24), 1000, dtype=np.int16)
    with open_terrain(tmp_path, heights, ONE_TILE, "EPSG:4326", mask=VOID) as terrain:
        pyramid = TilePyramid(terrain, void_height=-50, fill_voids=True, cells=32)
        # The tile that the raster fills.
        tile = pyramid.tile(9, 512, 256)
        points, triangles, _ = surface(tile)
        at = np.array([4.5, 12.0]) / 24 * SIZE
        found = heights_at(points, triangles, at, at)
        assert found.tolist() == pytest.approx([1000, -50], abs=pyramid.tolerance(9))
        assert tile.surface_error <= pyramid.tolerance(9)


def test_there_are_no_tiles_beside_the_raster(tmp_path):
    with open_terrain(tmp_path, steep(20, 20), UTM, "EPSG:32633") as terrain:
        pyramid = TilePyramid(terrain)
        last = pyramid.max_zoom
        for place in ((0, 2, 0), (0, 0, 1), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (last + 1, 0, 0)):
            assert pyramid.tile(*place) is None
        assert pyramid.tile(0, 0, 0) is not None


def test_raster_across_the_antimeridian_has_tiles_on_both_sides(tmp_path):
    # The central meridian of zone 1 is 177° W: 180° lies some 270 km west of it at 35° N.
    matrix = Affine(2000.0, 0.0, 2e5, 0.0, -2000.0, 4e6)
    with open_terrain(tmp_path, steep(40, 40), matrix, "EPSG:32601") as terrain:
        pyramid = TilePyramid(terrain, cells=CELLS)
        assert pyramid.extent.west < 180 < pyramid.extent.east
        zoom = pyramid.max_zoom
        west, east = pyramid.available(zoom)
        assert (west.first_x, east.last_x) == (0, 2 * 2**zoom - 1)
        y = (west.first_y + west.last_y) // 2
        assert pyramid.tile(zoom, 0, y).error is not None
        assert pyramid.tile(zoom, east.last_x, y).error is not None
        assert_edges_agree(pyramid, zoom, [((east.last_x, y), (0, y), "east", "west")])
        bounds = pyramid.layer()["bounds"]
        assert (bounds[0], bounds[2]) == (-180, 180)


def test_raster_over_a_pole_goes_around_it(tmp_path):
    side = 5e4
    matrix = Affine(side, 0, -16 * side, 0, -side, 16 * side)
    heights = steep(32, 32)
    with open_terrain(tmp_path, heights, matrix, "EPSG:3413") as terrain:
        pyramid = TilePyramid(terrain, cells=CELLS)
        assert pyramid.extent[0::2] == (-180, 180)
        assert pyramid.extent.north == 90
        zoom = pyramid.max_zoom
        n_x, y = 2 << zoom, (1 << zoom) - 1
        tops = [edge(pyramid.tile(zoom, x, y), "north") for x in (0, n_x // 3, n_x - 1)]
        found = {height for top in tops for height in top.values()}
        middle = heights[15:17, 15:17].mean()
        assert len(found) == 1
        assert found.pop() == pytest.approx(middle, abs=pyramid._heights.edge_step(zoom) / 256)
        assert_edges_agree(pyramid, zoom, [((n_x - 1, y), (0, y), "east", "west")])


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (2, 33), (65, 34)])
def test_any_size_has_tiles(tmp_path, shape):
    with open_terrain(tmp_path, steep(*shape), UTM, "EPSG:32633") as terrain:
        pyramid = TilePyramid(terrain, cells=CELLS)
        for zoom in (0, pyramid.max_zoom):
            for found in pyramid.available(zoom):
                tile = pyramid.tile(zoom, found.first_x, found.first_y)
                assert areas_in_steps(tile).sum() == 2 * 32767**2


def test_edges_of_triangles_lie_within_half_of_the_zooms_error_below_the_globe(tmp_path):
    matrix = Affine(2.8125, 0.0, -180.0, 0.0, -2.8125, 90.0)
    with open_terrain(tmp_path, np.zeros((64, 128), np.int16), matrix, "EPSG:4326") as terrain:
        pyramid = TilePyramid(terrain, cells=32)
        for zoom in range(2):
            points, triangles, _ = surface(pyramid.tile(zoom, 0, 0))
            corners = pyramid.globe.ellipsoid.geocentric(points)[triangles]
            edges = corners - np.roll(corners, 1, axis=1)
            longest = np.linalg.norm(edges, axis=2).max()
            below = longest**2 / 8 / pyramid.globe.ellipsoid.axis
            assert below <= pyramid.geometric_error(zoom) / 2


def test_raster_without_a_place_has_no_tiles(tmp_path):
    with open_terrain(tmp_path, steep(8, 8), Affine.identity(), None) as terrain:
        with pytest.raises(InvalidHeightsError, match="no coordinate reference system"):
            TilePyramid(terrain)


def tiles_listed(layer):
    """Return (zoom, x, y) of the tiles that a layer.json says are there."""
    return {
        (zoom, x, y)
        for zoom, ranges in enumerate(layer["available"])
        for one in ranges
        for x in range(one["startX"], one["endX"] + 1)
        for y in range(one["startY"], one["endY"] + 1)
    }


def tiles_in(folder):
    """Return (zoom, x, y) of the tiles of a folder."""
    return {
        tuple(map(int, path.relative_to(folder).with_suffix("").parts))
        for path in folder.rglob("*.terrain")
    }


def test_layer_names_every_tile_that_is_written(tmp_path):
    with open_terrain(tmp_path, steep(30, 60), UTM, "EPSG:32633") as terrain:
        zooms = write_tiles(terrain, tmp_path / "tiles", cells=CELLS, attribution="© somebody")
        layer = json.loads((tmp_path / "tiles" / "layer.json").read_text(encoding="utf-8"))
        pyramid = TilePyramid(terrain, cells=CELLS)
        assert layer == pyramid.layer(attribution="© somebody")
        assert layer["scheme"] == "tms"
        for x, y in pyramid.available(zooms[-1].zoom)[0].tiles():
            written = tmp_path / "tiles" / str(zooms[-1].zoom) / str(x) / f"{y}.terrain"
            assert written.read_bytes() == pyramid.tile(zooms[-1].zoom, x, y).data
    named = tiles_listed(layer)
    assert tiles_in(tmp_path / "tiles") == named
    assert sum(zoom.n_tiles for zoom in zooms) == len(named)
    assert layer["maxzoom"] == len(layer["available"]) - 1 == zooms[-1].zoom


def test_command_writes_a_directory_and_replaces_only_tiles(tmp_path):
    open_terrain(tmp_path, steep(20, 20), UTM, "EPSG:32633").close()
    twz, target = tmp_path / "dem.twz", tmp_path / "tiles"
    result = run("tiles", twz, target, "--max-zoom", 3, "--json")
    assert result.exit_code == 0, result.output
    assert [zoom["zoom"] for zoom in json.loads(result.stdout)["zooms"]] == [0, 1, 2, 3]
    again = run("tiles", twz, target, "--max-zoom", 2)
    assert (again.exit_code, again.stdout) == (1, "")
    assert "--overwrite" in again.stderr
    assert (target / "3").is_dir()
    assert run("tiles", twz, target, "--max-zoom", 2, "--overwrite", "-q").exit_code == 0
    assert not (target / "3").exists()
    (target / "layer.json").unlink()
    other = run("tiles", twz, target, "--overwrite")
    assert other.exit_code == 1
    assert "has no layer.json" in other.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dem.tif", "dem.twz", "tiles"]


def hills(n_rows, n_cols):
    """Return hills of some hundred metres with steep slopes, to whole decimetres."""
    row, col = np.mgrid[:n_rows, :n_cols]
    return np.round(300 * np.sin(row / 6) * np.cos(col / 7) + 40 * np.sin(row + col), 1)


def nearest_samples(terrain, pyramid, zoom, x, y):
    """Return longitudes, latitudes and heights of the samples in a tile, by PROJ through GDAL.

    Not of the two outermost rows and columns: triangles there touch what is outside.
    """
    heights = terrain.read().astype(np.float64)[2:-2, 2:-2]
    row, col = np.mgrid[2 : heights.shape[0] + 2, 2 : heights.shape[1] + 2]
    a, b, c, d, e, f = terrain.transform[:6]
    col, row = col.ravel() + 0.5, row.ravel() + 0.5
    east, north = a * col + b * row + c, d * col + e * row + f
    lon, lat = map(np.asarray, transform(CRS.from_string(terrain.crs), "EPSG:4326", east, north))
    size = 180 / (1 << zoom)
    inside = (lon > -180 + x * size) & (lon < -180 + (x + 1) * size)
    inside &= (lat > -90 + y * size) & (lat < -90 + (y + 1) * size)
    return lon[inside], lat[inside], heights.ravel()[inside]


@pytest.mark.few(1)
@pytest.mark.parametrize("max_error", [0, 0.5, 3])
@pytest.mark.parametrize("matrix", [UTM, Affine(150, 60, 4e5, 60, -150, 4e6)])
def test_the_finest_zoom_states_the_files_own_error_and_what_tiles_need(
    tmp_path, max_error, matrix
):
    """It was as coarse as its cells: several times this on hills."""
    heights = hills(60, 60).astype(np.float32)
    crs, coded = "EPSG:32633", {"max_error": max_error, "method": "rapid"}
    with open_terrain(tmp_path, heights, matrix, crs, **coded) as terrain:
        pyramid = TilePyramid(terrain, cells=32)
        zoom = pyramid.max_zoom
        bound = terrain.effective_error
        step = pyramid._heights.edge_step(zoom) / 256
        # Half of the bound or the step of heights for the mesh; half a step for rounding; what
        # rounding of places to 1/32767 of the tile does on the steepest slope (measured, gradient).
        slope = max(np.abs(np.gradient(heights, 150)).max() * 2, 0.1)
        moved = 180 / (1 << zoom) * 111_000 / 32767
        allowed = max(bound / 2, step) + step / 2 + slope * moved
        n_seen = 0
        (tiles,) = pyramid.available(zoom)
        for x, y in tiles.tiles():
            tile = pyramid.tile(zoom, x, y)
            if tile.error is None:
                continue
            assert tile.error == pytest.approx(tile.surface_error + bound)
            points, triangles, about = surface(tile)
            assert about["geometricerror"] == tile.error
            lon, lat, there = nearest_samples(terrain, pyramid, zoom, x, y)
            found = heights_at(points, triangles, lon, lat)
            apart = np.abs(found - there)
            assert apart.max(initial=0) <= tile.surface_error + 1e-3
            # Edges of tiles, and triangles at voids, have no vertices but at corners of cells:
            # samples nearer to them than 16 steps are as far off as these are, by the bend of a
            # pixel's slopes within a cell at most.
            west, south, east, north = about["bounds"]
            across = np.stack([lon - west, east - lon, lat - south, north - lat]).min(axis=0)
            is_inner = across > 16 * (east - west) / 32767
            assert apart[is_inner].max(initial=0) <= allowed
            assert tile.surface_error <= allowed + slope * 150 / 4
            n_seen += len(lon)
        assert n_seen == 56 * 56


@pytest.mark.full
def test_finest_tiles_cover_their_square_once_and_agree_on_edges(tmp_path):
    heights = hills(60, 60).astype(np.float32)
    mask = np.full(heights.shape, 255, dtype=np.uint8)
    mask[20:30, 25:40] = 0
    for crs, matrix in (
        ("EPSG:32633", UTM),
        ("EPSG:4326", Affine(1 / 512, 0, 10, 0, -1 / 512, 46)),
    ):
        # Degrees whose samples lie on the cells' own lines, too.
        with open_terrain(tmp_path, heights, matrix, crs, max_error=0, mask=mask) as terrain:
            pyramid = TilePyramid(terrain, fill_voids=True, cells=CELLS)
            zoom = pyramid.max_zoom
            (found,) = pyramid.available(zoom)
            for x, y in found.tiles():
                twice = areas_in_steps(pyramid.tile(zoom, x, y))
                assert (twice > 0).all()
                assert twice.sum() == 2 * 32767**2
            x, y = found.first_x, found.first_y
            pairs = [((x, y), (x + 1, y), "east", "west"), ((x, y), (x, y + 1), "north", "south")]
            assert_edges_agree(pyramid, zoom, pairs)


def test_errors_of_tiles_have_the_curvature_of_the_globe_between_their_vertices(tmp_path):
    matrix = Affine(1 / 60, 0.0, 10.0, 0.0, -1 / 60, 47.0)
    with open_terrain(tmp_path, np.zeros((65, 65), np.int16), matrix, "EPSG:4326") as terrain:
        pyramid = TilePyramid(terrain, cells=64)
        zoom = pyramid.max_zoom
        area = pyramid.available(zoom)[0]
        tile = pyramid.tile(zoom, area.last_x - 1, area.first_y + 1)
        points, triangles, about = surface(tile)
        middles = points[triangles].mean(axis=1)
        flat = pyramid.globe.ellipsoid.geocentric(points)[triangles].mean(axis=1)
        below = np.linalg.norm(flat - pyramid.globe.ellipsoid.geocentric(middles), axis=1).max()
        assert 0 < below <= about["surfaceerror"] <= about["geometricerror"]
        # edges are as short as the error that the tile's heights may have, or cells are whole
        whole = (180 / (64 << zoom) * 111e3) ** 2 / 4 / 6367000
        assert about["surfaceerror"] < max(2 * pyramid._heights.edge_tolerance(zoom), 1.5 * whole)
        line = [(area.first_x, area.first_y), (area.first_x + 1, area.first_y)]
        assert_edges_agree(pyramid, zoom, [(*line, "east", "west")])


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"cells": 12}, "found cells 12, expected a power of two"),
        ({"void_height": np.inf}, "found void_height inf, expected a finite number"),
        ({"void_height": 1e7}, "expected at most 4,000 km"),
    ],
)
def test_options_out_of_range_are_refused(tmp_path, options, line):
    with open_terrain(tmp_path, steep(8, 8), UTM, "EPSG:32633") as terrain:
        with pytest.raises(InvalidHeightsError, match=line):
            TilePyramid(terrain, **options)


def test_zooms_that_are_asked_for_are_written_and_listed(tmp_path):
    with open_terrain(tmp_path, steep(40, 40), UTM, "EPSG:32633") as terrain:
        whole = TilePyramid(terrain).available
        written = write_tiles(terrain, tmp_path / "t", min_zoom=4, max_zoom=6, threads=1)
        expected = {zoom: whole(zoom) for zoom in (0, 4, 5, 6)}
    assert [one.zoom for one in written] == [0, 4, 5, 6]
    layer = json.loads((tmp_path / "t" / "layer.json").read_text())
    assert (layer["minzoom"], layer["maxzoom"]) == (4, 6)
    assert [len(tiles) for tiles in layer["available"]] == [1, 0, 0, 0, 1, 1, 1]
    there = tiles_in(tmp_path / "t")
    assert tiles_listed(layer) == there
    assert len(there) == sum(tiles.n_tiles for one in expected.values() for tiles in one)
