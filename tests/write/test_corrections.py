"""Patches of lossy files move nothing beside them, one after the other, whatever comes first."""

import numpy as np
import pytest
import reference_decoder  # noqa: F401  # with all methods
from cases import some
from containers import open_container
from strategies import terrain_like, write_geotiff
from twz import grouped

import terrainwave
from terrainwave.codec import group
from terrainwave.codec.corrections import decode_corrections
from terrainwave.codec.unit_specs import unit_spec
from terrainwave.grid.quadtree import Block
from terrainwave.reference.units import decode
from terrainwave.terrain import Terrain
from terrainwave.write.patch import patch

VOID = -9999


def ridges(n_rows, n_cols):
    """Return heights with a lake of voids, an island in it, single ones, and a corner of voids."""
    row, col = np.mgrid[:n_rows, :n_cols]
    heights = 60 * np.sin((row + col) / 19) + 40 * (col // 31 % 2) + (row * 37 + col * 101) % 7
    distance = np.hypot(row - n_rows / 2, col - n_cols / 3)
    heights[(distance < 21) & (distance > 3) | ((row * 53 + col * 29) % 211 == 0)] = VOID
    heights[62:, 60:] = VOID
    return heights.astype("int16")


# Heights, the options of a file, and by how much patches change them.
RASTERS = {
    "voids": (ridges(131, 140), {"max_error": 5, "nodata": VOID}, 20),
    "rings": (ridges(131, 140), {"max_error": 5, "nodata": VOID, "border_rings": 3}, 20),
    "hills": (terrain_like(150, 110, seed=3), {"max_error": 2}, 9),
    "floats": (
        (terrain_like(120, 150, "float32", 4) * np.float32(1.7)).astype("float32"),
        {"max_error": 0.75, "mesh": "halves"},
        3,
    ),
}


CASES = [
    *((name, method) for method in ("rapid", "predictive") for name in RASTERS if name != "rings"),
    ("rings", "predictive"),
]


class Patched:
    """A file, the heights that it should be within the bound of, and patches at random places."""

    def __init__(self, directory, name, **options):
        self.heights, own, self.change = RASTERS[name]
        self.heights = self.heights.copy()
        self.options = {"block": 32, "mesh": "none", "threads": 1, **own, **options}
        self.bound = self.options["max_error"]
        self.path, self.new = directory / "dem.twz", directory / "new.tif"
        self.nodata = self.options.get("nodata")
        self.rng = np.random.default_rng(7)
        self.write(directory / "old.tif", self.heights)
        terrainwave.compress(directory / "old.tif", self.path, **grouped(self.options))
        self.lowest, self.highest = self.valid().min(), self.valid().max()

    def write(self, path, heights, row=0, col=0):
        transform = (2.0, 0.0, 1000.0 + 2 * col, 0.0, -2.0, 5000.0 - 2 * row)
        write_geotiff(path, heights, transform=transform, crs="EPSG:32610", nodata=self.nodata)

    def valid(self):
        is_void = self.heights == self.nodata
        return self.heights[~is_void]

    def levels(self):
        with Terrain(self.path) as terrain:
            return [
                (*terrain.read_with_mask(level=level, voids="any"), terrain.grid.stride(level))
                for level in range(terrain.n_levels)
            ]

    def patch(self):
        """Patch a random place; assert that nothing has moved beside it."""
        rng, shape = self.rng, self.heights.shape
        size = rng.integers(1, 60, 2)
        row, col = (int(rng.integers(0, n - s + 1)) for n, s in zip(shape, size, strict=True))
        at = slice(row, row + size[0]), slice(col, col + size[1])
        part = self.heights[at].astype(float)
        wave = self.change * np.sin(np.arange(size[0])[:, None] / 7 + np.arange(size[1]) / 5)
        part += wave + rng.uniform(-self.change, self.change)
        is_touched = rng.random() < 0.4
        if is_touched:  # what is there, but for a sample
            with Terrain(self.path) as terrain:
                part = terrain.read((row, col, *size)).astype(float)
            place = tuple(rng.integers(0, size))
            part[place] += 2 * self.change * rng.choice([-1, 1])
        part = np.clip(part, self.lowest, self.highest).astype(self.heights.dtype)
        if self.nodata is not None:
            part[self.heights[at] == self.nodata] = self.nodata
            if rng.random() < 0.3 and not is_touched:  # other voids
                part[: size[0] // 2, size[1] // 3 :] = self.nodata
            if rng.random() < 0.3:  # heights where voids were
                part[part == self.nodata] = self.highest - 3
        self.write(self.new, part, row, col)
        before = self.levels()
        result = patch(self.path, self.new)
        self.heights[at] = part
        for (old, was_valid, stride), (new, is_valid, _) in zip(before, self.levels(), strict=True):
            rows, cols = (stride * np.arange(n) for n in old.shape)
            beyond = (rows < row) | (rows >= row + size[0])
            stays = beyond[:, None] | (cols < col) | (cols >= col + size[1])
            stays &= was_valid == is_valid
            np.testing.assert_array_equal(new[stays], old[stays])
        return result

    def check(self, result):
        """Assert that the bound holds, and what is printed."""
        with Terrain(self.path) as terrain:
            found, valid = terrain.read_with_mask()
            stated = terrain.info().effective_error
        np.testing.assert_array_equal(valid, self.heights != self.nodata)
        error = np.abs(found.astype(float) - self.heights)[valid].max()
        spacing = np.spacing(np.float32(300)) if found.dtype.kind == "f" else 0
        assert error <= result.measured_error + spacing <= result.effective_error + spacing
        assert result.effective_error == stated <= self.bound

    def sections(self):
        """Return the number of corrections and the bytes of their sections."""
        n_corrections = n_bytes = 0
        with open_container(self.path) as container, Terrain(self.path) as terrain:
            header, grid = container.header, container.grid
            keys = [*grid.root_keys()]
            keys += [key for level in range(grid.k_max) for key in grid.blocks(level)]
            for key in keys:
                payload = container.payload(key)
                if payload and payload[0] & group.HAS_CORRECTIONS:
                    spec = unit_spec(grid, header.codec_parameters, key)
                    parent = None if key.is_root_key else terrain.decoder.block(key)
                    section = group.read_head(spec, parent, payload).corrections
                    n_corrections += np.count_nonzero(decode_corrections(section, spec).added)
                    n_bytes += len(section)
            assert header.has_corrections == (n_bytes > 0)
        return n_corrections, n_bytes


@pytest.mark.parametrize(
    ("name", "method", "n_patches"),
    [
        (*CASES[0], 8),
        *(pytest.param(*case, 6, marks=pytest.mark.full) for case in CASES[1:]),
    ],
)
def test_patches_move_nothing_beside_them(tmp_path, name, method, n_patches):
    patched = Patched(tmp_path, name, method=method)
    for number in range(n_patches):
        patched.check(patched.patch())
        n_corrections, n_bytes = patched.sections()
        # Of samples whose prediction has changed, those that a correction brings back are some.
        assert n_bytes <= 1.5 * n_corrections + 40, number
    with Terrain(patched.path) as terrain:
        assert list(terrain.check()) == []
        assert terrain.header.has_corrections
    patched.write(tmp_path / "all.tif", patched.heights)
    report = terrainwave.verify(patched.path, tmp_path / "all.tif", mesh=True)
    assert report.ok, report
    with Terrain(patched.path, threads=4, cache_bytes=0) as terrain:
        whole = terrain.read()
        for row, col in patched.rng.integers(0, 90, (20, 2)).tolist():
            part = whole[row : row + 33, col : col + 47]
            np.testing.assert_array_equal(terrain.read((row, col, *part.shape)), part)


@pytest.mark.full
@pytest.mark.parametrize(
    ("method", "mesh", "n_patches"),
    [
        ("rapid", "halves", 2),
        pytest.param("rapid", "zerotree-plain", 4, marks=pytest.mark.full),
        pytest.param("predictive", "halves", 4, marks=pytest.mark.full),
        pytest.param("predictive", "rqt", 4, marks=pytest.mark.full),
    ],
)
def test_errors_of_stored_meshes_hold_after_patches(tmp_path, method, mesh, n_patches):
    patched = Patched(tmp_path, "voids", method=method, mesh=mesh, measure_meshes=True)
    for _ in range(n_patches):
        patched.check(patched.patch())
        patched.write(tmp_path / "all.tif", patched.heights)
        report = terrainwave.verify(patched.path, tmp_path / "all.tif", mesh=True)
        assert report.ok, report


def test_errors_of_coarse_blocks_do_not_add_up(tmp_path):
    """Each patch added the largest change of a block's samples to what the file says of it."""
    patched = Patched(tmp_path, "hills", mesh="none")
    heights = patched.heights.copy()
    for n in range(8):
        patched.heights[60:69, 20:29] = heights.max() if n % 2 else heights.min()
        patched.write(patched.new, patched.heights[60:69, 20:29], 60, 20)
        patch(patched.path, patched.new)
    with Terrain(patched.path) as terrain:
        stated = terrain.block_error(Block(0, 0, 0))
        assert stated <= 2 * (heights.max() - heights.min()) + 4


def test_with_the_original_no_corrections_are_made(tmp_path):
    patched = Patched(tmp_path, "hills")
    new = patched.heights[60:90, 20:50].copy()
    new[:] = np.clip(new[::-1] + 5, patched.lowest, patched.highest)
    patched.write(patched.new, new, 60, 20)
    patch(patched.path, patched.new, original=tmp_path / "old.tif")
    with Terrain(patched.path) as terrain:
        assert not terrain.header.has_corrections


@pytest.mark.full
@pytest.mark.parametrize("method", some(["rapid", "predictive"], 2))
def test_units_with_corrections_agree_where_they_meet_with_the_original_too(tmp_path, method):
    patched = Patched(tmp_path, "floats", method=method)
    for _ in range(5):
        patched.patch()
    for row, col in ((33, 35), (35, 101), (97, 37), (99, 99)):  # each of one unit alone
        patched.write(tmp_path / "all.tif", patched.heights)
        height = patched.heights[row, col]
        middle = (patched.lowest + patched.highest) / 2
        patched.heights[row, col] = patched.lowest if height > middle else patched.highest
        patched.write(patched.new, patched.heights[row : row + 1, col : col + 1], row, col)
        result = patch(patched.path, patched.new, original=tmp_path / "all.tif")
        assert (result.n_recoded, result.n_copied) == (1, 9)
    decode(patched.path.read_bytes())


def test_corrections_go_with_what_they_put_back(tmp_path):
    """A patch of the whole area leaves none but where units meet."""
    patched = Patched(tmp_path, "hills")
    patched.patch()
    patched.patch()
    before = patched.sections()[0]
    patched.heights = np.clip(patched.heights + 7, patched.lowest, patched.highest)
    patched.write(patched.new, patched.heights)
    patch(patched.path, patched.new)
    assert patched.sections()[0] < before / 4


@pytest.mark.full
@pytest.mark.parametrize(("name", "method"), CASES[::2])
def test_the_slow_decoder_reads_patched_files(tmp_path, name, method):
    """It is written from docs/FORMAT.md alone, and finds units that disagree where they meet."""
    patched = Patched(tmp_path, name, method=method)
    for _ in range(4):
        patched.patch()
    assert patched.sections()[0] > 50
    for level, (heights, valid, _) in enumerate(patched.levels()):
        found, is_valid = decode(patched.path.read_bytes(), level)
        np.testing.assert_array_equal(is_valid, valid)
        np.testing.assert_array_equal(found[valid], heights[valid])
