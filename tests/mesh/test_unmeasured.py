"""Files that leave errors of meshes to who makes them: do the bounds hold that then follow?"""

from dataclasses import replace

import numpy as np
import pytest
from mesh_cases import make_case, reader, write_case

import terrainwave
from terrainwave.container.page import UNMEASURED, decode_error, encode_error
from terrainwave.mesh.sections import mesher_of
from terrainwave.verification.checks import CheckedMesh, deviation
from terrainwave.verification.on_grid import QuantaScale

CASES = {
    "ridges": ("ridges", "none", (161, 129), {"max_error": 1}),
    "ridges, exactly": ("ridges", "none", (97, 130), {"max_error": 0}),
    "roofs": ("roofs", "none", (129, 129), {"max_error": 0}),
    "patches": ("rough patch", "none", (150, 133), {"max_error": 3}),
    "voids": ("ridges", "disc", (140, 131), {"max_error": 2}),
    "holes": ("rough patch", "speckle", (129, 150), {"max_error": 0}),
    "floats": ("ridges", "none", (140, 99), {"max_error": 0.7, "dtype": "float32"}),
    "lowpass": ("ridges", "speckle", (120, 141), {"max_error": 2, "method": "cdf97"}),
    "tiles": ("ridges", "none", (150, 140), {"max_error": 2, "method": "cdf53"}),
}


def case_of(name, **options):
    kind, void, shape, own = CASES[name]
    return make_case(kind, void, shape, 5, amplitude=300.0, block=32, **own, **options)


def coarse_blocks(terrain):
    return [b for level in range(terrain.n_levels - 1) for b in terrain.grid.blocks(level)]


def largest_error(terrain, originals, valid, block, mesh):
    """How far originals are from a mesh, 1/16 quanta; by code that knows nothing of meshes."""
    stride, side = terrain.grid.stride(block.level), terrain.grid.block
    first = block.row * side * stride, block.col * side * stride
    surface = CheckedMesh(
        mesh.rows.astype(np.int64), mesh.cols.astype(np.int64), mesh.heights, mesh.triangles
    )
    at = -first[0], -first[1]
    return deviation(surface.on_grid(stride), originals, valid, np.inf, at).worst


@pytest.mark.few(3)
@pytest.mark.parametrize("name", CASES)
def test_no_original_is_further_than_the_bound_from_meshes_of_files_and_of_views(name, tmp_path):
    case = case_of(name)
    n_compared = n_above_the_sum = 0
    with terrainwave.open(write_case(case, tmp_path)) as terrain:
        assert not terrain.has_measured_meshes
        mesher, ruler = mesher_of(terrain), QuantaScale(terrain)
        raw, valid = reader(case)(terrain.region())
        originals = ruler.sixteenths(raw, valid)
        for block in coarse_blocks(terrain):
            own = decode_error(terrain.container.codes(block)[2]) * 16
            for mesh, tolerance in (
                (mesher.mesh(block), mesher.tolerance(block)),
                (mesher.view_mesh(block), mesher.view_tolerance(block)),
            ):
                found = largest_error(terrain, originals, valid, block, mesh)
                assert found <= mesher.derived_error(block, mesh) + ruler.slack
                n_above_the_sum += found > own + tolerance
                n_compared += len(mesh.triangles) > 0
    assert n_compared >= 10
    if name == "roofs":
        assert n_above_the_sum  # own error and tolerance are no bound


@pytest.mark.few(3)
@pytest.mark.parametrize("name", CASES)
def test_codes_say_that_coarse_meshes_are_not_measured_and_bound_the_finest(name, tmp_path):
    path = write_case(case_of(name), tmp_path)
    terrainwave.store_meshes(path, tmp_path / "measured.twz")
    kinds = set()
    with (
        terrainwave.open(path) as terrain,
        terrainwave.open(tmp_path / "measured.twz") as measured,
    ):
        assert measured.has_measured_meshes
        finest = terrain.n_levels - 1
        for level in range(terrain.n_levels):
            for block in terrain.grid.blocks(level):
                *_, error, code = terrain.container.codes(block)
                if not len(terrain.block_mesh(block).triangles):
                    expected, kind = 0, "no mesh"
                elif level < finest:
                    expected, kind = UNMEASURED, "coarse"
                else:
                    sixteenths = decode_error(error) * 16 + terrain.header.mesh_tolerance
                    expected, kind = encode_error(-(-sixteenths // 16)), "finest"
                assert code == expected
                assert terrain.mesh_error(block) >= 0
                assert (terrain.stored_mesh_error(block) is None) == (kind == "coarse")
                kinds.add(kind)
    assert kinds >= {"coarse", "finest"}
    assert ("no mesh" in kinds) == (name == "voids")


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["ridges", "voids", "tiles"])
def test_meshes_of_unmeasured_files_pass_verify(name, tmp_path):
    path = write_case(case_of(name), tmp_path)
    report = terrainwave.verify(path, tmp_path / "case.tif", mesh=True)
    assert report.ok, report.problems
    for level in report.mesh.levels:
        assert 0 < level.measured_error <= level.stored_error < 1e5


@pytest.mark.parametrize(
    ("options", "is_measured"),
    [
        ({}, False),
        ({"measure_meshes": True}, True),
        ({"mesh": "rqt"}, True),
        ({"mesh": "zerotree"}, True),
        ({"method": "cdf97", "faithful": True}, True),
        ({"mesh": "none", "measure_meshes": True}, False),
    ],
)
def test_stored_meshes_and_files_to_the_letter_are_measured(options, is_measured, tmp_path):
    case = make_case("ridges", "none", (70, 80), 5, amplitude=300.0, block=32, max_error=2)
    case = replace(case, options=case.options | options)
    with terrainwave.open(write_case(case, tmp_path)) as terrain:
        assert terrain.has_measured_meshes is is_measured
        assert terrain.info().measured_meshes is is_measured
