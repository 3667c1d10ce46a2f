"""Meshes of zero trees alone: watertight, once over their area, their errors true."""

import json
import os

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_cases import area_problems, cases, make_case, write_case
from render.scenes import hills

import terrainwave
from terrainwave.cli import main
from terrainwave.errors import InvalidArgumentError
from terrainwave.grid.quadtree import Region
from terrainwave.mesh.loose import LooseMesher
from terrainwave.mesh.sections import mesher_of
from terrainwave.render.modes import mode_class
from terrainwave.render.modes.mode import ModeNeeds
from terrainwave.render.scene.frame import frame_of
from terrainwave.render.scene.selection import Piece
from terrainwave.tri.block_mesh import FRACTION_BITS
from terrainwave.tri.mesh_distance import largest_deviation
from terrainwave.tri.stored_kinds import STORED_KINDS

N_EXAMPLES = 2 if os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"} else 10
SMOOTH = make_case("smooth", "none", (150, 200), 4, amplitude=900.0, max_error=2, block=32)


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    SMOOTH.options |= {"method": "cdf97", "mesh": "zerotree"}
    return write_case(SMOOTH, tmp_path_factory.mktemp("smooth"))


@given(case=cases(max_side=130), kind=st.sampled_from(["halves", "zerotree", "none"]))
@settings(max_examples=N_EXAMPLES)
def test_a_loose_mesh_is_watertight_and_tells_its_error(case, kind, tmp_path_factory):
    case.options["mesh"] = kind
    path = write_case(case, tmp_path_factory.mktemp("loose"))
    with terrainwave.open(path) as terrain:
        for level in range(terrain.n_levels - 1):
            n_rows, n_cols = terrain.level_shape(level)
            if min(n_rows, n_cols) < 2:
                continue
            mesh = terrain.mesh(level=level, guarantee=False)
            stride = terrain.grid.stride(level)
            region = Region(0, 0, (n_rows - 1) * stride + 1, (n_cols - 1) * stride + 1)
            problems = area_problems(terrain, case, mesh, region, level)
            assert [problem for problem in problems if "not covered" not in problem] == []


@pytest.mark.full
@pytest.mark.parametrize("max_error", [0, 1, 10])
@pytest.mark.parametrize(
    "method",
    [
        "rapid",
        *(pytest.param(name, marks=pytest.mark.full) for name in ("cdf97", "predictive", "cdf53")),
    ],
)
def test_most_samples_are_within_the_tolerance_of_a_loose_mesh(tmp_path, method, max_error):
    """By the definition: the mesh at each sample, beside what a guaranteed one may be off."""
    heights = np.round(hills(200, 260, 5)).astype(np.int16)
    path = tmp_path / "a.twz"
    terrainwave.compress(heights, path, max_error=max_error, method=method, block=32)
    with terrainwave.open(path) as terrain:
        for level in range(1, terrain.n_levels - 1):
            mesh = terrain.mesh(level=level, guarantee=False)
            assert mesh.share >= 0.95
            decoded = terrain.read(level=level).astype(float)
            apart = np.abs(surface_of(mesh, terrain, level) - decoded)
            blocks = terrain.grid.blocks(level)
            tolerances = [mesher_of(terrain).tolerance(block) for block in blocks]
            low, high = (
                (apart <= f(tolerances) / (1 << FRACTION_BITS) + 1e-9).mean() for f in (min, max)
            )
            assert low - 0.02 <= mesh.share <= high + 0.02
        assert terrain.mesh().share is None


def surface_of(mesh, terrain, level):
    """Return the heights of a mesh at the samples of a level."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    points = mesh.points
    surface = LinearTriInterpolator(
        Triangulation(points[:, 0], points[:, 1], mesh.triangles), points[:, 2]
    )
    n_rows, n_cols = terrain.level_shape(level)
    stride = terrain.grid.stride(level)
    a, _, c, _, e, f = terrain.raster_info.transform[:6]
    x = c + a * (np.arange(n_cols) * stride + 0.5)
    y = f + e * (np.arange(n_rows) * stride + 0.5)
    return surface(*np.meshgrid(x, y)).filled(np.nan)


def test_the_guaranteed_mesh_is_nowhere_coarser_than_the_trees(smooth):
    with terrainwave.open(smooth) as terrain:
        loose = LooseMesher(terrain)
        for block in terrain.grid.blocks(terrain.n_levels - 2):
            fine, coarse = terrain.block_mesh(block), loose.mesh(block)
            has = {(row, col) for row, col in zip(fine.rows, fine.cols, strict=True)}
            assert {(row, col) for row, col in zip(coarse.rows, coarse.cols, strict=True)} <= has


@pytest.mark.parametrize(
    "options", [{"max_error": 5}, {"max_triangles": 100}, {"optimise": 1}, {"level": 3}]
)
def test_a_loose_mesh_has_no_goal_and_no_finest_level(smooth, options):
    with terrainwave.open(smooth) as terrain:
        assert terrain.n_levels == 4
        with pytest.raises(InvalidArgumentError, match="expected"):
            terrain.mesh(guarantee=False, **options)


@pytest.mark.parametrize("kind", ["zerotree-plain", "rqt"])
def test_a_block_alone_keeps_any_tolerance(smooth, kind):
    with terrainwave.open(smooth) as terrain:
        samples = mesher_of(terrain).stored_samples(terrain.grid.blocks(3)[5])
        counts = []
        for tolerance in (0, 2 << FRACTION_BITS, 20 << FRACTION_BITS):
            mesh = STORED_KINDS[kind].alone(samples, tolerance)
            apart = largest_deviation(mesh, 1, samples.heights, samples.mask, 0, 0)
            assert apart <= tolerance
            counts.append(len(mesh.triangles))
        assert counts[0] > counts[-1]


def test_a_patch_of_a_loose_mesh_states_its_own_error(smooth):
    """The file's error, which the guaranteed mesh keeps, is less."""
    n_further = 0
    with terrainwave.open(smooth) as terrain:
        builder = mode_class("loose")(ModeNeeds(terrain, frame_of(terrain))).builder
        for block in terrain.grid.blocks(terrain.n_levels - 2):
            piece, region = Piece(*block), terrain.grid.full_region(block)
            heights = SMOOTH.heights[region.slices_in(Region(0, 0, *SMOOTH.heights.shape))]
            apart = largest_deviation(
                builder.mesh(piece), 2, heights.astype(np.int32), np.ones(heights.shape, bool), 0, 0
            ) / (1 << FRACTION_BITS)  # fmt: skip
            assert apart <= builder.build(piece).drawn_error
            n_further += apart > terrain.mesh_error(block)
    assert n_further > 0


def test_info_lists_what_the_meshes_of_each_level_hold(smooth):
    levels = json.loads(
        CliRunner().invoke(main, ["info", str(smooth), "--meshes", "--json"]).output
    )
    levels = levels["meshes"]
    with terrainwave.open(smooth) as terrain:
        for found, shape in zip(levels, terrain.info().level_shapes, strict=True):
            mesh = terrain.mesh(level=found["level"], optimise=0)
            # The blocks' own, which reach past the raster's edge, where the mesh is cut off.
            assert found["n_triangles"] == pytest.approx(mesh.n_triangles, rel=0.2, abs=40)
            assert 0 < found["label_bits"] < 2
            assert tuple(shape) == terrain.level_shape(found["level"])
        is_finest = [found["significant"] is None for found in levels]
        assert is_finest == [False, False, False, True]
        assert 0 < levels[1]["significant"] < 0.5
        assert levels[2]["n_loose"] < levels[2]["n_triangles"]
    table = CliRunner().invoke(main, ["info", str(smooth), "--meshes"]).output
    assert f"{levels[3]['n_triangles']:,}" in table
