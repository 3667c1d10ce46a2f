"""terrainwave render, and what view and render say of wrong options."""

import json

import numpy as np
import pytest
from commands import run
from render.scenes import hills

from terrainwave.write.compress import compress

pytestmark = [pytest.mark.gl, pytest.mark.large]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("render") / "hills.twz"
    compress(np.round(hills(150, 210, 1)).astype(np.int16), path, block=32)
    return str(path)


def pixels(path):
    from matplotlib.image import imread

    return np.round(imread(path)[..., :3] * 255).astype(int)


def test_a_picture_and_what_was_drawn(file, tmp_path):
    picture, stats = tmp_path / "a.png", tmp_path / "a.json"
    done = run("render", file, picture, "--size", "200x150", "--stats", stats,
               "--max-pixel-error", "2")  # fmt: skip
    assert done.exit_code == 0, done.output
    assert pixels(picture).shape == (150, 200, 3)
    said = json.loads(stats.read_text())
    assert said["max_pixel_error"] == 2.0
    assert said["n_triangles"] > 100
    assert said["n_draw_calls"] == 1
    assert f"--camera {said['camera']}" in done.output


def test_the_printed_camera_gives_the_same_picture(file, tmp_path):
    stats = tmp_path / "a.json"
    run("render", file, tmp_path / "a.png", "--size", "120x90", "--stats", stats)
    camera = json.loads(stats.read_text())["camera"]
    done = run("render", file, tmp_path / "b.png", "--size", "120x90", f"--camera={camera}")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.full
def test_a_legend_and_a_scale_bar_are_drawn_where_asked_for(file, tmp_path):
    size = ("--size", "300x200")
    run("render", file, tmp_path / "a.png", *size)
    done = run("render", file, tmp_path / "b.png", *size, "--legend", "--scale-bar")
    assert done.exit_code == 0, done.output
    differs = (pixels(tmp_path / "a.png") != pixels(tmp_path / "b.png")).any(axis=2)
    assert differs[:100, :100].mean() > 0.3  # the legend, above on the left
    assert differs[170:, 150:].mean() > 0.02  # the scale bar, below on the right
    assert not differs[60:150, 180:].any()


def test_a_flight_writes_numbered_pictures(file, tmp_path):
    keys = ["100,40,500,0,-40,50", "120,60,450,30,-35,50"]
    path = tmp_path / "flight.json"
    path.write_text(json.dumps(keys))
    done = run("render", file, tmp_path / "f.png", "--size", "64x48", "--flight", path,
               "--frames", "3", "--quiet")  # fmt: skip
    assert done.exit_code == 0, done.output
    assert sorted(p.name for p in tmp_path.glob("f-*.png")) == [
        "f-0000.png", "f-0001.png", "f-0002.png",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("options", "words", "status"),
    [
        (["--size", "12"], "1920x1280", 2),
        (["--camera", "1,2"], "x,y,z,heading,pitch,fov", 2),
        (["--sun", "1"], "two finite numbers", 2),
        (["--mode", "best"], "adaptive", 2),
        (["--background", "red"], "hexadecimal", 2),
        (["--radius", "0"], "--radius", 2),
        (["--size", "200000x2"], "pixels", 2),
        (["--bounds", "5,5,1,1"], "left < right", 2),
        (["--coloring", "ground"], "'auto', 'absolute', 'relative'", 2),
        (["--legend", "--coloring", "plain"], "found --legend with --coloring plain", 2),
        (["--tree", "16"], "--tree in mode adaptive, expected mode dynamic", 2),
        (["--error", "coefficient"], "found --error 'coefficient' in mode adaptive", 2),
        (["--scale-bar", "--size", "100x90"], "found --size 100x90, expected at least", 2),
    ],
)
def test_a_wrong_option_is_one_line(file, tmp_path, options, words, status):
    done = run("render", file, tmp_path / "x.png", *options)
    assert done.exit_code == status
    lines = [line for line in done.output.splitlines() if not line.startswith("compiling")]
    assert len(lines) == 1
    assert words in lines[0]
    assert not (tmp_path / "x.png").exists()


def test_an_existing_picture_is_kept_unless_told(file, tmp_path):
    (tmp_path / "x.png").write_text("mine")
    assert run("render", file, tmp_path / "x.png", "--size", "20x20").exit_code == 1
    assert (tmp_path / "x.png").read_text() == "mine"
    done = run("render", file, tmp_path / "x.png", "--size", "20x20", "--overwrite")
    assert done.exit_code == 0, done.output


# What these modes compile takes long.
_FRONTS = [pytest.param(mode, marks=pytest.mark.full) for mode in ("dynamic", "rqt")]


@pytest.mark.few(1)
@pytest.mark.parametrize("mode", ["adaptive", "batched", "full", *_FRONTS])
def test_the_measured_error_of_a_picture_is_within_its_promise(file, tmp_path, mode):
    stats = tmp_path / "a.json"
    done = run("render", file, tmp_path / "a.png", "--size", "200x150", "--mode", mode,
               "--max-pixel-error", "2", "--measure", "--stats", stats)  # fmt: skip
    assert done.exit_code == 0, done.output
    said = json.loads(stats.read_text())
    within, measured = said["max_pixel_error"], said["measured_pixel_error"]
    assert 0 < measured <= within <= 2
    assert said["caption"] == f"within {within:.3g} pixels"
    assert f"{said['caption']}; measured {measured:.3g} pixels" in done.output


def refused(tmp_path, heights, *options):
    """Return the line that refuses a picture of an array with the void -1."""
    compress(np.asarray(heights, dtype=np.int16), tmp_path / "a.twz", nodata=-1, max_error=0,
             overwrite=True)  # fmt: skip
    done = run("render", tmp_path / "a.twz", tmp_path / "x.png", "--size", "60x40", "--quiet",
               *options)  # fmt: skip
    assert not (tmp_path / "x.png").exists()
    lines = [line for line in done.output.splitlines() if not line.startswith("compiling")]
    assert len(lines) == 1
    return done.exit_code, lines[0]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9)])
def test_a_raster_without_a_surface_is_one_line(tmp_path, shape):
    status, line = refused(tmp_path, np.ones(shape))
    assert status == 1
    assert f"the raster has {shape[0]} x {shape[1]}" in line


def test_a_raster_of_voids_is_one_line(tmp_path):
    status, line = refused(tmp_path, np.full((40, 40), -1))
    assert (status, "voids only" in line) == (1, True)
