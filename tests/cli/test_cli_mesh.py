"""`terrainwave mesh` and height tiles on the command line: words, numbers, exit status."""

import json
import re

import pytest
import trimesh
from commands import one_line, run
from PIL import Image
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff
from tri.meshes import grid_mesh

import terrainwave
from terrainwave.terrain import Terrain


def make(tmp_path, **profile):
    options = {"crs": "EPSG:32611", "transform": Affine(30, 0, 4e5, 0, -30, 4e6)} | profile
    write_geotiff(tmp_path / "dem.tif", terrain_like(33, 20), units=("m",), **options)
    path = tmp_path / "dem.twz"
    terrainwave.compress(tmp_path / "dem.tif", path, max_error=0, method="store", block=32)
    return path


@pytest.fixture
def twz(tmp_path):
    return make(tmp_path)


@pytest.fixture
def asked(monkeypatch):
    """Let `Terrain.mesh` give two triangles per cell; return the options it was called with."""
    asked = {}

    def mesh(self, *, progress, **options):
        asked.update(options)
        heights = self.read(options["window"], bounds=options["bounds"])
        return grid_mesh(
            heights, self.transform[:6], error=0.5, crs=self.crs, units=self.raster_info.units
        )

    monkeypatch.setattr(Terrain, "mesh", mesh, raising=False)
    return asked


@pytest.mark.few(1)
@pytest.mark.large
@pytest.mark.parametrize("goal", [{"max_error": 3}, {"max_triangles": 700}, {}])
def test_the_command_and_python_make_the_same_mesh(tmp_path, goal):
    path = tmp_path / "dem.twz"
    terrainwave.compress(terrain_like(70, 90), path, max_error=1, block=32)
    words = [
        word for name, value in goal.items() for word in (f"--{name}".replace("_", "-"), value)
    ]
    saved = json.loads(run("mesh", path, tmp_path / "a.ply", "--json", *words).stdout)
    with terrainwave.open(path) as terrain:
        plain, swept, default = (terrain.mesh(optimise=n, **goal) for n in (0, 1, None))
        loose = terrain.mesh(guarantee=False)
    assert saved["n_triangles"] == default.n_triangles == swept.n_triangles
    assert (default.points == swept.points).all()
    assert loose.error > 0
    if "max_triangles" not in goal:
        assert default.n_triangles < 0.8 * plain.n_triangles


def test_mesh_prints_what_was_written(tmp_path, twz, asked):
    target = tmp_path / "area.ply"
    result = run("mesh", twz, target)
    assert result.exit_code == 0, result.output
    first, second = result.stdout.splitlines()
    n_bytes = target.stat().st_size
    assert first == f"{target}: 1,216 triangles, 660 vertices, {n_bytes:,} bytes"
    assert second == "guaranteed error 0.5 m, frame native"


def test_options_reach_the_mesh(tmp_path, twz, asked):
    options = "--max-error 2 --max-triangles 99 --level -2 --window 0,0,5,6 --no-optimise"
    assert run("mesh", twz, tmp_path / "a.ply", *options.split()).exit_code == 0
    assert asked == {
        "max_error": 2.0,
        "max_triangles": 99,
        "level": -2,
        "window": (0, 0, 5, 6),
        "bounds": None,
        "optimise": 0,
        "guarantee": True,
    }


def test_levels_of_detail_print_a_row_each(tmp_path, twz):
    result = run("mesh", twz, tmp_path / "a.glb", "--lods", "3", "--max-error", "2")
    assert result.exit_code == 0, result.output
    *lines, last = result.stdout.splitlines()
    pattern = r"(.*): [\d,]+ triangles, [\d,]+ bytes, guaranteed error ([\d.]+) m"
    found = [re.fullmatch(pattern, line).groups() for line in lines]
    assert [name for name, _ in found] == [str(tmp_path / f"a_lod{k}.glb") for k in range(3)]
    assert [float(error) <= 2 * 2**k for k, (_, error) in enumerate(found)] == [True] * 3
    assert last == "frame native"
    assert {path.name for path in tmp_path.glob("*.glb")} == {f"a_lod{k}.glb" for k in range(3)}


def test_json_of_levels_of_detail_has_each(tmp_path, twz):
    words = ("mesh", twz, tmp_path / "a.obj", "--lods", "2", "--json", "--up", "y", "--skirts", 9)
    lods = json.loads(run(*words).stdout)["lods"]
    assert [one["path"] for one in lods] == [str(tmp_path / f"a_lod{k}.obj") for k in range(2)]
    assert lods[0]["error"] <= lods[1]["error"]


def test_json_of_mesh_is_complete(tmp_path, twz, asked):
    target = tmp_path / "a.glb"
    result = run("mesh", twz, target, "--json")
    found = json.loads(result.stdout)
    assert found["path"] == str(target)
    assert found["n_triangles"] == 1216
    assert found["units"] == "m"
    assert found["error"] == 0.5 + found["rounding"]
    assert found["origin"] == pytest.approx([4e5 + 300, 4e6 - 495, 0])


def test_an_existing_target_is_refused_before_the_work(tmp_path, twz, asked):
    (tmp_path / "a.ply").write_text("mine")
    line = one_line(run("mesh", twz, tmp_path / "a.ply"), 1)
    assert "already exists" in line
    assert asked == {}
    assert run("mesh", twz, tmp_path / "a.ply", "--overwrite").exit_code == 0


def test_a_picture_is_in_the_file_and_a_larger_one_is_noted(tmp_path, twz, asked, monkeypatch):
    monkeypatch.setattr("terrainwave.raster_io.drape._MOST_IN_FILE", 16)
    Image.new("RGB", (40, 66), (255, 0, 0)).save(tmp_path / "plain.png")
    result = run("mesh", twz, tmp_path / "a.glb", "--drape", tmp_path / "plain.png")
    assert result.exit_code == 0
    assert re.search(r"note: .*plain\.png has \d+ x \d+ pixels over the mesh", result.stderr)
    found = trimesh.load(tmp_path / "a.glb", force="mesh").visual.material.baseColorTexture
    assert max(found.size) == 16
    assert found.getpixel((0, 0)) == (255, 0, 0)


def test_the_file_itself_is_no_target(tmp_path, twz, asked):
    source = tmp_path / "dem.ply"
    twz.rename(source)
    assert "is the file to be read" in one_line(run("mesh", source, source, "--overwrite"), 1)


def test_store_adds_meshes_to_a_copy(tmp_path):
    terrainwave.compress(terrain_like(70, 80), tmp_path / "dem.twz", block=32, mesh="none")
    result = run("mesh", "--store", tmp_path / "dem.twz", tmp_path / "out.twz", "--mesh-error", "2")
    assert result.exit_code == 0, result.output
    n_bytes = (tmp_path / "out.twz").stat().st_size
    assert result.stdout == f"{tmp_path / 'out.twz'}: {n_bytes:,} bytes, with meshes\n"
    with terrainwave.open(tmp_path / "out.twz") as terrain:
        assert terrain.mesh_kind == "halves"
        assert terrain.info().mesh_tolerance == 2


@pytest.mark.parametrize("name", ["tile.r16", "tile.png"])
def test_decompress_writes_a_height_tile(tmp_path, twz, name):
    result = run("decompress", twz, tmp_path / name, "--size", "17")
    assert result.exit_code == 0, result.output
    assert str(tmp_path / name) in result.stdout
    about = json.loads((tmp_path / f"{name}.json").read_text())
    assert (about["rows"], about["columns"]) == (17, 17)
    assert "note: the window of 33 x 20 samples is stretched to 17 x 17" in result.stderr
    assert "--size window keeps the raster's own" in result.stderr


def with_error(monkeypatch, smallest):
    """Let `Terrain.mesh` reach any error asked for, down to `smallest`; return those asked for."""
    asked = []

    def mesh(self, max_error, **options):
        asked.append(max_error)
        if max_error < smallest:
            raise terrainwave.InvalidHeightsError("too small")
        return grid_mesh(self.read() / 7, self.transform[:6], error=max_error, crs=self.crs)

    monkeypatch.setattr(Terrain, "mesh", mesh)
    return asked


@pytest.mark.parametrize("name", ["a.stl", "a.glb"])
def test_mesh_leaves_room_for_rounding(tmp_path, twz, monkeypatch, name):
    asked = with_error(monkeypatch, smallest=0.5)
    found = json.loads(run("mesh", twz, tmp_path / name, "--max-error", "2", "--json").stdout)
    assert 1.9 < found["error"] <= 2
    assert len(asked) == 2
    assert asked[1] < 2 - found["rounding"]


def test_a_mesh_that_fits_is_made_once(tmp_path, twz, monkeypatch):
    asked = with_error(monkeypatch, smallest=0.5)
    assert "rounding" not in run("mesh", twz, tmp_path / "a.ply", "--max-error", "2").stderr
    assert asked == [2.0]


def test_a_bound_that_rounding_breaks_is_told(tmp_path, twz, monkeypatch):
    with_error(monkeypatch, smallest=2.0)
    result = run("mesh", twz, tmp_path / "a.stl", "--max-error", "2")
    assert result.exit_code == 0
    assert "note: rounding of coordinates in the file makes the error larger than" in result.stderr
    assert (tmp_path / "a.stl").exists()


def test_tile_leaves_room_for_rounding_and_curvature(tmp_path, twz, monkeypatch):
    asked = with_error(monkeypatch, smallest=0.5)
    found = json.loads(
        run("mesh", twz, tmp_path / "a.terrain", "--max-error", "2", "--json").stdout
    )
    # 1/16 is the curvature's, which takes next to nothing of it on cells of 30 m
    assert asked == [2 - 2 / 16]
    assert asked[0] + found["rounding"] < found["error"] <= 2
