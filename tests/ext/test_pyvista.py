"""pyvista finds the reader by its entry point."""

import numpy as np
import pytest
import pyvista
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave

PLACE = {"crs": "EPSG:32633", "transform": Affine(30, 0, 500_000, 0, -30, 5_000_000)}


@pytest.fixture
def twz(tmp_path):
    """A file of 20 x 25 samples with meshes."""
    tif = write_geotiff(tmp_path / "a.tif", terrain_like(20, 25), units=("m",), **PLACE)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=1, block=32)
    return tmp_path / "a.twz"


def test_file_is_read_as_a_surface_in_local_metres(twz):
    surface = pyvista.read(twz)
    with terrainwave.open(twz) as terrain:
        mesh = terrain.mesh()
    assert surface.n_cells == mesh.n_triangles
    # 24 x 19 steps of 30 m between the centres of the outermost pixels.
    left, right, bottom, top, _, _ = surface.bounds
    assert (right - left, top - bottom) == (24 * 30, 19 * 30)
    assert surface.active_scalars_name == "heights"
    np.testing.assert_array_equal(surface["heights"], mesh.points[:, 2])
    assert surface.field_data["error"][0] == mesh.error
    assert surface.field_data["units"][0] == "m"


def test_bound_window_and_frame_can_be_chosen(twz):
    fine, coarse = (pyvista.read(twz, max_error=error) for error in (2, 20))
    assert coarse.n_cells < fine.n_cells
    part = pyvista.read(twz, window=(0, 0, 10, 20), frame="native")
    origin = part.field_data["origin"]
    assert part.bounds[0] + origin[0] == 500_015
    assert part.bounds[1] + origin[0] == 500_015 + 19 * 30


def test_file_without_meshes_gets_one_within_its_bound_and_quantum(tmp_path):
    terrainwave.compress(terrain_like(20, 20), tmp_path / "a.twz", max_error=1, mesh="none")
    surface = pyvista.read(tmp_path / "a.twz", frame="native")
    assert 0 < surface.field_data["error"][0] <= 2  # bound 1 and quantum 1


def test_damaged_file_is_an_error_of_terrainwave(tmp_path):
    (tmp_path / "a.twz").write_bytes(b"\x89TWZ")
    with pytest.raises(terrainwave.CorruptStreamError):
        pyvista.read(tmp_path / "a.twz")
