"""Pictures in glTF files: which colour lies where, what is filled, what is refused."""

import io
import json
import struct
import warnings
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import trimesh
from PIL import Image
from pyproj import Transformer
from rasterio.enums import ColorInterp
from rasterio.warp import transform_bounds
from tri.meshes import grid_mesh, hills

from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
    StorageError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.export.gltf import GROUND_COLOR
from terrainwave.export.mesh_files import save_mesh
from terrainwave.export.shapes import MESH_ENDINGS
from terrainwave.grid.affine import Footprint
from terrainwave.raster_io import drape

SHAPE = (21, 31)
UTM = (30.0, 0.0, 500000.0, 0.0, -30.0, 5200000.0)
# Left, bottom, right, top of the centres of the outermost pixels, and the middle.
AREA = (500015.0, 5199385.0, 500915.0, 5199985.0)
MIDDLE = (500465.0, 5199685.0)
RED, GREEN, BLUE, YELLOW = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)
# As a map shows them, north above.
QUARTERS = ((RED, GREEN), (BLUE, YELLOW))
CRS = "EPSG:32633"


def terrain_mesh(**options):
    return grid_mesh(hills(*SHAPE), UTM, **{"crs": CRS, "units": "m"} | options)


def bands_of(colors, shape):
    """Return a picture of two by two colours, uint8 (3, n_rows, n_cols)."""
    n_rows, n_cols = shape
    of_pixel = np.ix_(np.arange(n_rows) * 2 // n_rows, np.arange(n_cols) * 2 // n_cols)
    return np.moveaxis(np.array(colors, dtype=np.uint8)[of_pixel], -1, 0)


def write(path, bands, *, bounds=AREA, crs=CRS, alpha=False, **profile):
    bands = np.asarray(bands)
    count, height, width = bands.shape
    left, bottom, right, top = bounds
    across, down = (right - left) / width, (bottom - top) / height
    transform = rasterio.Affine(across, 0.0, left, 0.0, down, top)
    with rasterio.open(
        path, "w", count=count, height=height, width=width, dtype=bands.dtype,
        **{"driver": "GTiff", "crs": crs, "transform": transform} | profile,
    ) as target:  # fmt: skip
        if alpha:
            target.colorinterp = [*target.colorinterp[:-1], ColorInterp.alpha]
        target.write(bands)
    return path


def document_of(path):
    """Return the JSON of a .glb file and the bytes behind it."""
    data = path.read_bytes()
    (n_bytes,) = struct.unpack("<I", data[12:16])
    return json.loads(data[20 : 20 + n_bytes]), data[28 + n_bytes :]


def picture_of(path):
    """Return the picture inside a .glb file, and what the file says it is."""
    document, data = document_of(path)
    (image,) = document["images"]
    view = document["bufferViews"][image["bufferView"]]
    part = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    picture = Image.open(io.BytesIO(part))
    assert image["mimeType"] == f"image/{picture.format.lower()}"
    return np.asarray(picture.convert("RGB")), image["mimeType"]


def colors_at_vertices(path):
    """Return the points of a .glb and the colours of its picture there, as trimesh reads them."""
    found = trimesh.load(path, process=False, force="mesh")
    colors = found.visual.to_color().vertex_colors[:, :3].astype(int)
    return np.asarray(found.vertices), colors


def expected_color(east, north):
    return np.array(QUARTERS)[(north < 0).astype(int), (east > 0).astype(int)]


def assert_quarters(east, north, colors, margin):
    """Compare colours with those of the quarters around the middle, but for a seam."""
    inside = (np.abs(east) > margin) & (np.abs(north) > margin)
    assert inside.sum() > 300
    assert np.abs(colors - expected_color(east, north))[inside].max() < 40


@pytest.mark.parametrize("crs", [CRS, "EPSG:4326", "EPSG:3857", None])
@pytest.mark.parametrize("frame", ["native", "local"])
def test_each_colour_lies_where_the_picture_has_it(tmp_path, crs, frame):
    """glTF's x points to the east and z to the south; the frames' middle is that of the area."""
    plain = {} if crs else {"driver": "PNG", "transform": rasterio.Affine.identity()}
    bounds = transform_bounds(CRS, crs, *AREA) if crs else AREA
    bands = bands_of(QUARTERS, (200, 300))
    photo = write(tmp_path / "photo", bands, bounds=bounds, crs=crs, **plain)
    saved = save_mesh(terrain_mesh(), tmp_path / "a.glb", frame=frame, drape=photo)
    points, colors = colors_at_vertices(tmp_path / "a.glb")
    if frame == "native":
        assert saved.origin[:2] == MIDDLE
    assert len(points) == saved.n_vertices
    assert_quarters(points[:, 0], -points[:, 2], colors, margin=20.0)


def test_each_colour_lies_where_the_picture_has_it_on_the_globe(tmp_path):
    photo = write(tmp_path / "photo.tif", bands_of(QUARTERS, (200, 300)))
    saved = save_mesh(terrain_mesh(), tmp_path / "a.glb", frame="ecef", drape=photo)
    points, colors = colors_at_vertices(tmp_path / "a.glb")
    geocentric = points[:, [0, 2, 1]] * (1, -1, 1) + np.array(saved.origin)
    east, north, _ = Transformer.from_crs("EPSG:4978", "EPSG:32633+4979").transform(*geocentric.T)
    assert_quarters(east - MIDDLE[0], north - MIDDLE[1], colors, margin=20.0)


def test_where_the_picture_ends_is_plain_ground(tmp_path):
    left, bottom, _, top = AREA
    bounds = (left, bottom, MIDDLE[0], top)
    photo = write(tmp_path / "photo.tif", bands_of(((RED, RED),) * 2, (60, 45)), bounds=bounds)
    save_mesh(terrain_mesh(), tmp_path / "a.glb", drape=photo)
    found, _ = picture_of(tmp_path / "a.glb")
    # 60 x 90 pixels are over the mesh; sides are powers of two.
    assert found.shape[:2] == (64, 128)
    assert (found[:, :62] == RED).all()
    assert (found[:, 66:] == GROUND_COLOR).all()


@pytest.mark.parametrize("kind", ["nodata", "alpha", "mask"])
def test_what_the_picture_does_not_know_is_plain_ground(tmp_path, kind):
    bands = bands_of(((RED, GREEN), (BLUE, (9, 9, 9))), (60, 90))
    known = ~(bands == 9).all(axis=0)
    path = tmp_path / "photo.tif"
    if kind == "nodata":
        write(path, bands, nodata=9)
    elif kind == "alpha":
        write(path, [*bands, known.astype(np.uint8) * 255], alpha=True)
    else:
        write(path, bands)
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
            file.write_mask(known)
    save_mesh(terrain_mesh(), tmp_path / "a.glb", drape=path)
    found, _ = picture_of(tmp_path / "a.glb")
    assert (found[34:, 66:] == GROUND_COLOR).all()
    assert (found[:30, :62] == RED).all()


def test_a_large_picture_gets_smaller_with_a_note(tmp_path, monkeypatch):
    monkeypatch.setattr(drape, "_MOST_IN_FILE", 64)
    photo = write(tmp_path / "photo.tif", bands_of(QUARTERS, (120, 180)))
    with pytest.warns(TerrainwaveWarning, match=r"180 x 120 pixels .* the file has 64 x 64"):
        save_mesh(terrain_mesh(), tmp_path / "a.glb", drape=photo)
    assert picture_of(tmp_path / "a.glb")[0].shape[:2] == (64, 64)
    points, colors = colors_at_vertices(tmp_path / "a.glb")
    assert_quarters(points[:, 0], -points[:, 2], colors, margin=30.0)
    photo = write(tmp_path / "small.tif", bands_of(QUARTERS, (20, 64)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save_mesh(terrain_mesh(), tmp_path / "b.glb", drape=photo)
    assert picture_of(tmp_path / "b.glb")[0].shape[:2] == (32, 64)


def test_a_plain_picture_covers_the_raster_of_a_window(tmp_path):
    """Of the red quarter alone, north-west: red all over. Pixels are halves of samples."""
    Image.fromarray(np.moveaxis(bands_of(QUARTERS, (42, 62)), 0, -1)).save(tmp_path / "plain.png")
    mesh = grid_mesh(hills(9, 14), UTM, crs=CRS)
    mesh = replace(mesh, attributes={"footprint": Footprint(UTM, SHAPE)})
    save_mesh(mesh, tmp_path / "a.glb", drape=tmp_path / "plain.png")
    assert (picture_of(tmp_path / "a.glb")[0] == RED).all()


def test_a_gltf_file_has_the_picture_inside(tmp_path):
    photo = write(tmp_path / "photo.tif", bands_of(QUARTERS, (60, 90)))
    save_mesh(terrain_mesh(), tmp_path / "a.gltf", drape=photo)
    points, colors = colors_at_vertices(tmp_path / "a.gltf")
    assert_quarters(points[:, 0], -points[:, 2], colors, margin=20.0)


@pytest.mark.parametrize("suffix", [name for name in MESH_ENDINGS if name not in (".glb", ".gltf")])
def test_other_formats_hold_no_picture(tmp_path, suffix):
    with pytest.raises(InvalidArgumentError, match=r"found drape for \S+, expected .*\.glb"):
        save_mesh(terrain_mesh(), tmp_path / f"a{suffix}", drape=tmp_path / "photo.tif")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("make", "kind", "words"),
    [
        (lambda path: None, StorageError, "no such file"),
        (lambda path: path.write_text("no picture"), StorageError, "not a raster that GDAL"),
        (lambda path: path.mkdir(), StorageError, "is a directory"),
        (
            lambda path: write(path, np.zeros((3, 9, 9), np.uint8), nodata=0),
            InvalidHeightsError,
            "void or clear all over the mesh",
        ),
        (
            lambda path: write(path, np.ones((3, 9, 9), np.uint8), crs=None),
            InvalidHeightsError,
            "has no coordinate reference system and the terrain has one",
        ),
    ],
)
def test_what_cannot_be_draped_is_one_line(tmp_path, make, kind, words):
    make(tmp_path / "photo.tif")
    with pytest.raises(TerrainwaveError, match=words) as caught:
        save_mesh(terrain_mesh(), tmp_path / "a.glb", drape=tmp_path / "photo.tif")
    assert isinstance(caught.value, kind)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "a.glb").exists()
