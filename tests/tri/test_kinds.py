"""Files whose meshes are of the kinds `zerotree` and `rqt`, from the raster to the checker."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import some
from click.testing import CliRunner
from containers import copied_segments
from hypothesis import given, settings
from hypothesis import strategies as st
from mesh_cases import cases, make_case, reader, write_case
from twz import mesh_of

import terrainwave
from terrainwave.cli import main
from terrainwave.container.writer import assemble
from terrainwave.errors import CorruptStreamError, InvalidArgumentError
from terrainwave.grid.quadtree import Block
from terrainwave.mesh.sections import pack_section
from terrainwave.read.decoder import unit_key
from terrainwave.tri.stored_kinds import STORED_KINDS
from terrainwave.tri.zerotree.agreement import border_of
from terrainwave.verification.mesh_walk import MeshVerification
from terrainwave.write.meshes import store_meshes

N_EXAMPLES = 2 if os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"} else 8
# Coded trees are of faithful files alone: tests/codec/test_cdf97.py.
# Coefficients are of cdf53 alone: below.
# Making meshes of all kinds compiles for a minute; `make test` decodes them (tests/test_golden.py).
pytestmark = pytest.mark.slow_compile

KINDS = sorted({*STORED_KINDS} - {"zerotree-coded", "rqt-coefficient"})
BY_COEFFICIENT = {"mesh": "rqt-coefficient", "method": "cdf53"}


def with_kind(case, kind, **options):
    return replace(case, options={**case.options, "mesh": kind, **options})


def blocks_of(terrain):
    return [block for level in range(terrain.n_levels) for block in terrain.grid.blocks(level)]


def check_meshes(terrain, case, kind):
    """Check that all meshes are surfaces, of this kind, and have the errors that they state."""
    assert terrain.mesh_kind == kind
    report, problems = MeshVerification(terrain, reader(case)).run()
    assert problems == []
    for level in report.levels:
        assert level.measured_error <= level.stored_error * (1 + 1e-9) + terrain.info().quantum
    assert MeshVerification(terrain).run()[1] == []


@given(case=cases(max_side=130), kind=st.sampled_from(KINDS))
@settings(max_examples=N_EXAMPLES)
def test_all_meshes_of_a_file_are_right(case, kind, tmp_path_factory):
    path = write_case(with_kind(case, kind), tmp_path_factory.mktemp("all"))
    with terrainwave.open(path, threads=1) as terrain:
        check_meshes(terrain, case, kind)


@pytest.mark.full
@given(case=cases(max_side=130))
@settings(max_examples=N_EXAMPLES)
def test_meshes_by_coefficient_are_surfaces_that_state_the_error_they_have(case, tmp_path_factory):
    options = {**case.options, **BY_COEFFICIENT, "border_rings": 1}
    path = write_case(replace(case, options=options), tmp_path_factory.mktemp("coefficient"))
    with terrainwave.open(path, threads=1) as terrain:
        # Heights that do not compress are stored as they are, which has no coefficients.
        kind = "rqt-coefficient" if terrain.info().method == "cdf53" else "rqt"
        check_meshes(terrain, case, kind)


@pytest.mark.large
def test_a_mesh_by_coefficient_claims_no_tolerance_but_its_measured_error(tmp_path):
    case = make_case("cliffs", "none", (100, 130), 4, amplitude=900.0, max_error=0, block=32)
    measured, selected = tmp_path / "measured", tmp_path / "selected"
    paths = []
    for folder, kind in ((measured, "rqt"), (selected, "rqt-coefficient")):
        folder.mkdir()
        paths.append(write_case(with_kind(case, kind, method="cdf53", mesh_error=9), folder))
    with terrainwave.open(paths[0]) as bounded, terrainwave.open(paths[1]) as terrain:
        assert bounded.mesh(optimise=0).error <= 9 < terrain.mesh(optimise=0).error
        assert terrain.mesh(optimise=0).n_triangles < 0.9 * 2 * case.heights.size
        # What is made anew keeps what it is asked for.
        assert terrain.mesh(max_error=9).error <= 9
    found = CliRunner().invoke(main, ["info", os.fspath(paths[1])])
    assert "rqt-coefficient, coefficients above 9; errors are measured" in found.output
    assert terrainwave.verify(paths[1], selected / "case.tif", mesh=True).ok


def test_meshes_by_coefficient_need_coefficients(tmp_path):
    case = make_case("smooth", "none", (40, 40), 1, max_error=1, block=32)
    with pytest.raises(InvalidArgumentError, match="expected one of method cdf53"):
        write_case(with_kind(case, "rqt-coefficient"), tmp_path)
    path = write_case(case, tmp_path)
    with pytest.raises(InvalidArgumentError, match="expected one of method cdf53"):
        store_meshes(path, tmp_path / "other.twz", mesh=terrainwave.Rqt(select="coefficient"))


@pytest.mark.large
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("void", some(["disc", "none"], 2))
def test_meshes_of_every_level_are_right_and_few(kind, void, tmp_path):
    case = make_case("smooth", void, (200, 230), 4, amplitude=900.0, max_error=2, block=32)
    path = write_case(with_kind(case, kind), tmp_path)
    assert terrainwave.verify(path, tmp_path / "case.tif", mesh=True).ok
    with terrainwave.open(path) as terrain:
        for level in range(terrain.n_levels):
            mesh = terrain.mesh(level=level)
            n_rows, n_cols = terrain.level_shape(level)
            assert 0 < mesh.n_triangles
            if void == "none":
                assert mesh.n_triangles < 2 * n_rows * n_cols
        finest = terrain.mesh(optimise=0)
        assert finest.n_triangles < 0.7 * case.heights.size
        assert finest.error == max(
            terrain.mesh_error(block) for block in terrain.grid.blocks(terrain.n_levels - 1)
        )
        within = terrain.mesh(max_error=20)
        assert within.error <= 20


@pytest.mark.large
@pytest.mark.parametrize("kind", KINDS)
def test_any_number_of_threads_gives_the_same_bytes(kind, tmp_path):
    case = make_case("half sea", "speckle", (150, 140), 5, max_error=1, block=32)
    found = []
    for threads in (1, 3, 8):
        directory = tmp_path / str(threads)
        directory.mkdir()
        found.append(write_case(with_kind(case, kind, threads=threads), directory).read_bytes())
    assert found[0] == found[1] == found[2]


@pytest.mark.large
@pytest.mark.parametrize("kind", KINDS)
def test_meshes_stored_later_are_those_of_compress(kind, tmp_path):
    case = make_case("rough patch", "disc", (150, 140), 5, max_error=1, block=32)
    path = write_case(with_kind(case, kind), tmp_path)
    bare = tmp_path / "bare"
    bare.mkdir()
    plain = write_case(with_kind(case, "none"), bare)
    later = tmp_path / "later.twz"
    mesh = mesh_of(kind)
    store_meshes(plain, later, mesh=mesh, original=tmp_path / "case.tif", threads=2)
    assert later.read_bytes() == path.read_bytes()
    # Other meshes over stored ones leave nothing of these.
    again = tmp_path / "again.twz"
    halves = tmp_path / "halves.twz"
    store_meshes(plain, halves, mesh="halves")
    store_meshes(path, again, mesh="halves")
    assert again.read_bytes() == halves.read_bytes()


def test_a_raster_of_one_line_has_no_meshes(tmp_path):
    for kind in KINDS:
        for shape in ((1, 70), (70, 1), (1, 1)):
            case = make_case(
                "smooth", "none", shape, 1, max_error=1, block=32, mesh=kind, method="cdf97"
            )
            path = write_case(case, tmp_path)
            with terrainwave.open(path) as terrain:
                for block in blocks_of(terrain):
                    assert len(terrain.block_mesh(block).triangles) == 0
                    assert terrain.mesh_error(block) == 0


class Samples:
    def __init__(self, heights, mask):
        self.heights, self.mask, self.locked = heights, mask, ~mask
        self.coefficients = None


@given(seed=st.integers(0, 1 << 16), n_rows=st.integers(2, 33), n_cols=st.integers(2, 33))
@settings(max_examples=N_EXAMPLES)
def test_border_vertices_of_an_rqt_come_back(seed, n_rows, n_cols):
    rng = np.random.default_rng(seed)
    heights = np.cumsum(rng.integers(-5, 6, (n_rows, n_cols)), axis=1).astype(np.int32)
    samples, kind = Samples(heights, rng.random((n_rows, n_cols)) > 0.02), STORED_KINDS["rqt"]
    tolerance = int(rng.integers(0, 200))
    wanted = border_of(rng.random((n_rows, n_cols)) < rng.choice([0.02, 0.5]))
    draft = kind.draft(samples, tolerance, wanted)
    data = kind.encode(samples, tolerance, draft)
    mesh = kind.mesh(samples, tolerance, data)
    again = kind.draft(samples, tolerance, draft.border)
    assert all(np.array_equal(a, b) for a, b in zip(again.border, draft.border, strict=True))
    if samples.mask.all():
        found = np.zeros((n_rows, n_cols), dtype=bool)
        found[mesh.rows >> 1, mesh.cols >> 1] = True
        for own, line in zip(border_of(found), draft.border, strict=True):
            assert np.array_equal(own, line)


def test_the_example_of_the_annex():
    text = (Path(__file__).parents[2] / "docs" / "format-mesh-rqt.md").read_text("utf-8")
    payload = bytes.fromhex(text.split("```")[1])
    samples = Samples(np.zeros((5, 5), dtype=np.int32), np.ones((5, 5), dtype=bool))
    mesh = STORED_KINDS["rqt"].mesh(samples, 16, payload)
    vertices = [f"({row},{col})" for row, col in zip(mesh.rows >> 1, mesh.cols >> 1, strict=True)]
    assert text.split("Vertices: ")[1].splitlines()[0] == ", ".join(vertices) + "."
    wanted = np.zeros((5, 5), dtype=bool)
    wanted[0, 1] = True
    draft = STORED_KINDS["rqt"].draft(samples, 16, border_of(wanted))
    assert STORED_KINDS["rqt"].encode(samples, 16, draft) == payload


def with_section(path, target, key, section):
    """Write a file with another mesh section of a key, checksums and all."""
    with terrainwave.open(path, threads=1) as terrain, target.open("wb") as file:
        container = terrain.container
        codes = {block: container.codes(block)[3] for block in blocks_of(terrain)}
        spools = copied_segments(terrain, codes, target.parent)
        head = None if key.is_root_key else terrain.grid.segment_head(key)
        spools[head].set_mesh(key, section)
        assemble(file, container.header, spools)
    return target


@pytest.mark.large
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_sections_give_a_mesh_or_a_clear_error(kind, tmp_path):
    case = make_case("rough patch", "disc", (100, 100), 2, amplitude=900.0, max_error=3, block=32)
    path = write_case(with_kind(case, kind), tmp_path)
    rng = np.random.default_rng(0)
    n_refused = 0
    with terrainwave.open(path) as terrain:
        block = next(b for b in blocks_of(terrain)[::-1] if terrain.container.mesh(unit_key(b)))
        key = unit_key(block)
        section = terrain.container.mesh(key)
        heights = terrain.read()
    assert with_section(path, tmp_path / "same.twz", key, section).read_bytes() == path.read_bytes()
    flipped = []
    for _ in range(10):
        data = bytearray(section)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        flipped.append(bytes(data))
    for data in [section[:-1], section + b"\0", b"\xff" * 40, bytes(5), bytes(100), *flipped]:
        hostile = with_section(path, tmp_path / "hostile.twz", key, data)
        with terrainwave.open(hostile) as terrain:
            for part in terrain.grid.key_blocks(key):
                try:
                    mesh = terrain.block_mesh(part)
                except CorruptStreamError:
                    n_refused += 1
                    continue
                n_rows, n_cols = case.options["block"] + 1, case.options["block"] + 1
                assert mesh.triangles.max(initial=-1) < len(mesh.rows) <= n_rows * n_cols
            assert np.array_equal(terrain.read(), heights)
    assert n_refused > 10


@pytest.mark.large
def test_bytes_for_a_block_without_a_mesh_are_corrupt(tmp_path):
    case = make_case("smooth", "none", (100, 100), 2, max_error=3, block=32, mesh="rqt")
    case.valid[:40, :40] = False
    path = write_case(case, tmp_path)
    key = Block(1, 0, 0)
    hostile = with_section(path, tmp_path / "hostile.twz", key, pack_section([b"a", b"", b"", b""]))
    with terrainwave.open(hostile) as terrain, pytest.raises(CorruptStreamError, match="no mesh"):
        terrain.block_mesh(Block(2, 0, 0))
