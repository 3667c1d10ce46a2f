"""Are meshes watertight, once over their area and within what they state? Checked by other code."""

import json
import os
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from commands import environment, python
from containers import copied_segments
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_cases import (
    KINDS,
    VOIDS,
    area_problems,
    cases,
    make_case,
    reader,
    terrain,
    validity,
    write_case,
)

import terrainwave
from terrainwave.container.writer import assemble
from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.quadtree import Block, Region
from terrainwave.mesh import area as extraction
from terrainwave.mesh import cut
from terrainwave.mesh.fitted import BlockFitter
from terrainwave.mesh.mesh_data import MeshData
from terrainwave.tri.halves.borders import beside_void
from terrainwave.tri.halves.halves import Lines, triangulate
from terrainwave.tri.halves.simplify import simplify
from terrainwave.verification.mesh_walk import MeshVerification
from terrainwave.write.meshes import store_meshes

N_EXAMPLES = 3 if os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"} else 15


def full_region(grid, level, window):
    """Return what a window of a level covers of the full grid."""
    row, col, n_rows, n_cols = window
    stride = grid.stride(level)
    return Region(
        row * stride,
        col * stride,
        min((n_rows - 1) * stride, grid.n_rows - 1 - row * stride) + 1,
        min((n_cols - 1) * stride, grid.n_cols - 1 - col * stride) + 1,
    )


@given(case=cases(max_side=100))
@settings(max_examples=N_EXAMPLES)
def test_all_meshes_of_a_file_are_right(case, tmp_path_factory):
    path = write_case(case, tmp_path_factory.mktemp("all"))
    with terrainwave.open(path, threads=1) as terrain:
        report, problems = MeshVerification(terrain, reader(case)).run()
        assert problems == []
        assert report.against == "original"
        for level in report.levels:
            assert level.measured_error <= level.stored_error * (1 + 1e-9) + terrain.info().quantum
        assert MeshVerification(terrain).run()[1] == []


@given(case=cases(max_side=130), data=st.data())
@settings(max_examples=N_EXAMPLES)
def test_a_mesh_of_any_window_level_and_error_is_right(case, data, tmp_path_factory):
    path = write_case(case, tmp_path_factory.mktemp("window"))
    with terrainwave.open(path, threads=1) as terrain:
        grid, info = terrain.grid, terrain.info()
        for _ in range(3):
            level = data.draw(st.sampled_from([grid.k_max, grid.k_max, *range(grid.k_max)]))
            n_rows, n_cols = terrain.level_shape(level)
            if min(n_rows, n_cols) < 2:
                continue
            row, col = data.draw(st.integers(0, n_rows - 2)), data.draw(st.integers(0, n_cols - 2))
            window = (
                row, col, data.draw(st.integers(2, n_rows - row)),
                data.draw(st.integers(2, n_cols - col)),
            )  # fmt: skip
            share = data.draw(st.sampled_from([None, 0.0, 0.001, 0.01, 0.05, 0.3, 1.0]))
            error = None
            if share is not None:
                error = terrain.effective_error + share * (info.maximum - info.minimum)
            sweeps = data.draw(st.sampled_from([0, 1, 3]))
            region = full_region(grid, level, window)
            if min(region.shape) < 2:
                continue
            try:
                mesh = terrain.mesh(window, level=level, max_error=error, optimise=sweeps)
            except InvalidHeightsError as problem:
                is_refused = "max_error" in str(problem)  # coarse levels can't reach any error
            else:
                is_refused = False
            if is_refused:
                assert level < grid.k_max
                assert error is not None
                continue
            of_one_level = level if error is None or level == 0 else None
            assert area_problems(terrain, case, mesh, region, of_one_level, error) == []


@pytest.mark.full
@pytest.mark.parametrize(("void", "share"), [("none", 1), ("disc", 4), ("corners", 1)])
def test_meshes_of_many_levels_meet_without_gaps(void, share, tmp_path, monkeypatch):
    """With `share` 1 coarse blocks are taken that may then fail, and are split again."""
    levels = []
    assemble_all = extraction._Extractor._assemble

    def spy(extractor, built):
        levels.append({block.level for block in built})
        return assemble_all(extractor, built)

    monkeypatch.setattr(extraction._Extractor, "_assemble", spy)
    monkeypatch.setattr(cut, "_COARSE_SHARE", share)
    for seed, shape in ((5, (385, 289)), (7, (513, 170))):
        case = make_case(
            "graded", void, shape, seed, dtype="int32", amplitude=1e6, block=32, max_error=3,
            mesh="none", method="predictive",
        )  # fmt: skip
        path = write_case(case, tmp_path)
        with terrainwave.open(path) as terrain:
            for error, sweeps in ((600, 0), (4000, 1), (20000, 2)):
                for window in (None, (37, 3, 200, 160)):
                    region = Region(*(window or (0, 0, *shape)))
                    mesh = terrain.mesh(window, max_error=error, optimise=sweeps)
                    assert area_problems(terrain, case, mesh, region, None, error) == []
    assert max(map(len, levels)) >= (3 if void == "none" else 2)


@pytest.mark.full
@pytest.mark.parametrize(("shape", "is_beside_finer"), [((257, 225), True), ((300, 214), False)])
def test_coarse_blocks_reach_the_rasters_edge(shape, is_beside_finer, tmp_path, monkeypatch):
    """Beside finer ones where the coarse level has samples on the edge; 214 - 1 is odd."""
    found = []
    assemble_all = extraction._Extractor._assemble

    def spy(extractor, built):
        grid, beside = extractor._grid, cut.Cut(extractor._area, built)
        for block in built:
            reach = grid.block * grid.stride(block.level)
            on_edge = (block.col + 1) * reach >= grid.n_cols - 1
            if block.level < grid.k_max and on_edge:
                sides = {side for side, _ in beside.finer(block)}
                found.append(bool(sides & {"top", "bottom"}))
        return assemble_all(extractor, built)

    monkeypatch.setattr(extraction._Extractor, "_assemble", spy)
    for kind, seed in (("graded", 2), ("rough patch", 5), ("smooth", 3)):
        case = make_case(
            kind, "none", shape, seed, dtype="int32", amplitude=1e6, block=32, max_error=3,
            mesh="none", method="predictive",
        )  # fmt: skip
        path = write_case(case, tmp_path)
        with terrainwave.open(path) as terrain:
            for error in (1500, 9000, 40000, 4e5, 4e6):
                mesh = terrain.mesh(max_error=error)
                region = Region(0, 0, *shape)
                assert area_problems(terrain, case, mesh, region, None, error) == []
            # Any height will do: the root block alone.
            assert mesh.n_triangles <= 2 * 33 * 33
    assert found
    assert any(found) == is_beside_finer


@pytest.mark.large
def test_an_edge_through_a_corner_of_the_window_leaves_no_sliver(tmp_path):
    """The crossing was computed beside the corner: a vertex on another one, a triangle of none."""
    case = make_case(
        "flat", "corners", (197, 38), 41468, dtype="uint16", amplitude=9000.0, transform=2,
        scale=0.1, offset=100.0, max_error=4.5, mesh_error=0.0, block=64, method="store",
    )  # fmt: skip
    with terrainwave.open(write_case(case, tmp_path), threads=1) as terrain:
        for row in range(0, 120, 7):
            for sweeps in (0, 4):
                region = Region(row, 7, 76, 6)
                mesh = terrain.mesh(tuple(region), max_error=0, optimise=sweeps)
                assert area_problems(terrain, case, mesh, region, terrain.grid.k_max, 0) == []


@pytest.mark.large
def test_bounds_name_the_same_mesh_as_their_window(tmp_path):
    case = make_case("smooth", "disc", (90, 100), 3, transform=1, max_error=2, block=32)
    with terrainwave.open(write_case(case, tmp_path)) as terrain:
        a, _, c, _, e, f = case.transform
        bounds = (c + 20 * a, f + 70 * e, c + 60 * a, f + 10 * e)
        one, other = (
            terrain.mesh(bounds=bounds, max_error=5),
            terrain.mesh((10, 20, 60, 40), max_error=5),
        )
        assert np.array_equal(one.points, other.points)
        assert area_problems(terrain, case, one, Region(10, 20, 60, 40), None, 5) == []
        left, bottom, right, top = one.bounds
        assert (left, right) == (c + 20.5 * a, c + 59.5 * a)
        assert (bottom, top) == (f + 69.5 * e, f + 10.5 * e)


@pytest.mark.large
def test_an_error_below_the_files_is_refused(tmp_path):
    case = make_case("smooth", "none", (80, 70), 1, max_error=5, block=32)
    with terrainwave.open(write_case(case, tmp_path)) as terrain:
        with pytest.raises(InvalidHeightsError, match=r"max_error 4\.9, expected at least 5"):
            terrain.mesh(max_error=4.9)
        assert terrain.mesh(max_error=5).error <= 5
        with pytest.raises(InvalidHeightsError, match="max_triangles"):
            terrain.mesh(max_triangles=1)


@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (90, 1)])
def test_a_single_line_of_samples_has_no_mesh(shape, tmp_path):
    case = make_case("smooth", "none", shape, 1, max_error=1, block=32)
    path = write_case(case, tmp_path)
    with terrainwave.open(path) as terrain:
        with pytest.raises(InvalidHeightsError, match="at least 2 x 2"):
            terrain.mesh(max_error=10)
        report, problems = MeshVerification(terrain, reader(case)).run()
        assert problems == []
        assert report.areas == ()


@pytest.mark.few(1)
@pytest.mark.large
@pytest.mark.parametrize("n_most", [64, 300, 700])
def test_a_budget_of_triangles_is_kept(n_most, tmp_path):
    case = make_case("smooth", "none", (100, 100), 1, max_error=1, block=32)
    with terrainwave.open(write_case(case, tmp_path)) as terrain:
        mesh = terrain.mesh(max_triangles=n_most)
        assert mesh.n_triangles <= n_most
        assert area_problems(terrain, case, mesh, Region(0, 0, 100, 100), None) == []
        finer = terrain.mesh(max_triangles=4 * n_most)
        assert finer.error <= mesh.error


@pytest.mark.full
@pytest.mark.parametrize(("void", "ratio"), [("speckle", 1.3), ("checkerboard", 2.4)])
def test_a_budget_is_used_beside_voids_as_without(void, ratio, tmp_path):
    """Outlines of voids took the budget, so that the mesh was one of a far coarser level."""
    shape, errors = (150, 140), {}
    for name in ("none", void):
        case = make_case("smooth", name, shape, 5, max_error=1, block=32, method="predictive")
        with terrainwave.open(write_case(case, tmp_path)) as terrain:
            for n_most in (500, 2000):
                mesh = terrain.mesh(max_triangles=n_most, optimise=0)
                assert 0.95 * n_most <= mesh.n_triangles <= n_most
                assert area_problems(terrain, case, mesh, Region(0, 0, *shape), None) == []
                errors[name, n_most] = mesh.error
    for n_most in (500, 2000):
        assert errors[void, n_most] <= ratio * errors["none", n_most]


@pytest.mark.large
def test_a_try_beyond_the_budget_ends_early(tmp_path, monkeypatch):
    """The finest mesh, which the budget has no room for, was made all the same."""
    case = make_case("noise", "none", (130, 130), 1, max_error=1, block=32)
    made = []

    def counted(self, whole, block):
        meshed = build(self, whole, block)
        made.append(len(meshed.mesh.triangles))
        return meshed

    build = BlockFitter.build
    monkeypatch.setattr(BlockFitter, "build", counted)
    with terrainwave.open(write_case(case, tmp_path), threads=1) as terrain:
        area = cut.Area(terrain.grid, Region(0, 0, 130, 130), terrain.grid.k_max)
        extractor = extraction._Extractor(
            terrain, area, MeshData, Inline(), extraction.Reporter(None)
        )
        with pytest.raises(extraction._TooManyTrianglesError):
            extractor._mesh_within(Fraction(2), 3000)
    assert 3000 < sum(made) < 6000


class Inline:
    """An executor that does one thing after the other, when its result is asked for."""

    def map(self, function, values):
        return map(function, values)


@pytest.mark.large
def test_any_number_of_threads_gives_the_same_bytes_and_meshes(tmp_path):
    case = make_case("half sea", "disc", (200, 170), 4, max_error=2, block=32)
    found = []
    for threads in (1, 3):
        case.options["threads"] = threads
        path = write_case(case, tmp_path)
        with terrainwave.open(path, threads=threads) as terrain:
            meshes = [terrain.mesh(max_error=e, optimise=s) for e, s in ((3, 1), (25, 0))]
        found.append((path.read_bytes(), meshes))
    assert found[0][0] == found[1][0]
    for one, other in zip(found[0][1], found[1][1], strict=True):
        assert np.array_equal(one.vertices, other.vertices)
        assert np.array_equal(one.triangles, other.triangles)
        assert one.error == other.error


def kernel_meshes():
    """Return meshes that the kernels of `tri` make of hard terrains, as lists."""
    found = []
    for kind, void in zip(KINDS, (*VOIDS, "none"), strict=True):
        heights = (300 * terrain(kind, (23, 27), 3)).astype(np.int32)
        beyond = np.ones((25, 29), bool)
        beyond[1:-1, 1:-1] = mask = validity(void, heights.shape, 3)
        locked = beside_void(beyond)
        lines = [np.ones(n, bool) for n in (27, 27, 23, 23)]
        mesh = triangulate(heights, mask, locked, Lines(*lines), 16 * 20, (3, 5))
        for result in (mesh, simplify(mesh, heights, mask, 16 * 20, 3)):
            found.append([values.tolist() for values in result])
    return found


@pytest.mark.full
def test_kernels_give_the_same_meshes_as_plain_python():
    code = "import json, sys, test_mesh; json.dump(test_mesh.kernel_meshes(), sys.stdout)"
    without = environment(NUMBA_DISABLE_JIT="1")
    ran = python(code, env=without, check=True, cwd=os.path.dirname(__file__))
    assert json.loads(ran.stdout) == kernel_meshes()


def with_mesh_code(path, target, block, code):
    """Write a file whose index states another error code of a block's mesh."""
    with terrainwave.open(path, threads=1) as terrain, target.open("wb") as file:
        container = terrain.container
        codes = {block: code}
        for one in (b for level in range(terrain.n_levels) for b in terrain.grid.blocks(level)):
            codes.setdefault(one, container.codes(one)[3])
        spools = copied_segments(terrain, codes, target.parent)
        assemble(file, replace(container.header), spools)
    return target


@pytest.mark.few(1)
@pytest.mark.large
@pytest.mark.parametrize("level", [0, 1, 2])
def test_an_understated_error_is_found(level, tmp_path):
    case = make_case(
        "rough patch", "none", (100, 100), 2, amplitude=900.0, max_error=3, block=32,
        measure_meshes=True,
    )  # fmt: skip
    path = write_case(case, tmp_path)
    with terrainwave.open(path) as terrain:
        assert terrain.has_measured_meshes
        block = max(
            (b for b in terrain.grid.blocks(level)),
            key=lambda b: terrain.container.codes(b)[3],
        )
        code = terrain.container.codes(block)[3]
    assert terrainwave.verify(path, tmp_path / "case.tif", mesh=True).ok
    less = with_mesh_code(path, tmp_path / "less.twz", block, code - 9)
    report = terrainwave.verify(less, tmp_path / "case.tif", mesh=True)
    assert any(
        f"mesh of block {tuple(block)}" in problem and "stated error" in problem
        for problem in report.problems
    )
    assert terrainwave.verify(less, tmp_path / "case.tif").ok  # heights are fine
    same = with_mesh_code(path, tmp_path / "same.twz", block, code)
    assert same.read_bytes() == path.read_bytes()


@pytest.mark.large
def test_without_the_original_an_error_far_too_small_is_found(tmp_path):
    case = make_case("noise", "none", (70, 70), 2, amplitude=900.0, max_error=1, block=32)
    path = write_case(case, tmp_path)
    assert terrainwave.verify(path, mesh=True).ok
    less = with_mesh_code(path, tmp_path / "less.twz", Block(0, 0, 0), 1)
    assert "stated error" in " ".join(terrainwave.verify(less, mesh=True).problems)


@pytest.mark.large
def test_meshes_stored_later_are_checked_too(tmp_path):
    case = make_case("smooth", "disc", (90, 100), 3, max_error=2, block=32, mesh="none")
    path = write_case(case, tmp_path)
    report, problems = None, None
    with terrainwave.open(path) as terrain:
        report, problems = MeshVerification(terrain, reader(case)).run()
    assert problems == []
    assert report.levels == ()  # only meshes of the area
    store_meshes(path, tmp_path / "later.twz", mesh_error=7)
    assert terrainwave.verify(tmp_path / "later.twz", tmp_path / "case.tif", mesh=True).ok


def covered_area(mesh):
    """Return the area of a mesh's triangles over the plane."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner], :2] for corner in range(3))
    (x_1, y_1), (x_2, y_2) = (b - a).T, (c - a).T
    return float(np.abs(x_1 * y_2 - x_2 * y_1).sum() / 2)


@pytest.mark.large
def test_a_budget_that_outlines_leave_room_for_keeps_them(tmp_path):
    shape = (100, 100)
    case = make_case("noise", "none", shape, 1, max_error=1, block=32)
    case.valid[20:40, 30:60] = False
    with terrainwave.open(write_case(case, tmp_path)) as terrain:
        mesh = terrain.mesh(max_triangles=2000)
        # Quads with a void, of which the four at the corners have one triangle.
        uncovered = 21 * 31 - 4 * 0.5
        assert covered_area(mesh) == 99 * 99 - uncovered
        assert area_problems(terrain, case, mesh, Region(0, 0, *shape), None) == []
        assert covered_area(terrain.mesh(max_triangles=150)) > 99 * 99 - uncovered


@pytest.mark.large
def test_a_budget_does_not_hide_an_error_that_cannot_be_had(tmp_path):
    case = make_case("smooth", "none", (100, 100), 1, max_error=5, block=32)
    with terrainwave.open(write_case(case, tmp_path)) as terrain:
        with pytest.raises(InvalidHeightsError, match="expected at least 5"):
            terrain.mesh(max_triangles=10**6, max_error=1)


def test_the_stated_error_of_a_file_can_be_asked_for(tmp_path):
    """As float64 it may be less than the exact one."""
    case = make_case(
        "steps", "none", (24, 32), 62027, dtype="float64", amplitude=5e4, scale=-2.0, offset=100.0,
        max_error=5000.0, block=64, method="store",
    )  # fmt: skip
    with terrainwave.open(write_case(case, tmp_path)) as terrain:
        mesh = terrain.mesh(max_error=terrain.effective_error)
        assert mesh.error <= terrain.effective_error * (1 + 1e-12)


def test_any_error_beyond_the_heights_makes_the_same_mesh():
    heights = np.add.outer(np.arange(65), np.arange(65) ** 2).astype(np.int32)
    with terrainwave.open(terrainwave.compress_to_bytes(heights, block=32)) as found:
        meshes = [found.mesh(max_error=error) for error in (1e7, 1e18, 1e300)]
    assert len({len(mesh.triangles) for mesh in meshes}) == 1
