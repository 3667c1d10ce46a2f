"""Clicks, measurements, captures and the ground under the camera."""

import json
import threading

import numpy as np
import pytest
from PIL import Image
from render.scenes import ListStore, terrain_of

from terrainwave.render.gpu.overlay import draw_overlay, line_triangles
from terrainwave.render.look.style import Style
from terrainwave.render.paging.background import Background
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, home
from terrainwave.render.scene.measure import Ruler, read_profile
from terrainwave.render.window.controls import Controls
from terrainwave.render.window.ground import Ground
from terrainwave.render.window.pictures import read_flight
from terrainwave.render.window.session import Session

pytestmark = pytest.mark.large

VIEWPORT = Viewport(320, 240)


def ramp():
    """Return heights that rise by a metre per column, from 100."""
    return (100 + np.tile(np.arange(80), (60, 1))).astype(np.int16)


@pytest.fixture(scope="module")
def terrain():
    heights = ramp()
    heights[30:33, 40:43] = -32768
    with terrain_of(heights, max_error=1, nodata=-32768, block=32) as terrain:
        yield terrain


class Stage:
    """A session on a scene that has settled, and what it says."""

    def __init__(self, terrain, folder):
        self.said = []
        self.scene = Scene(terrain, ListStore())
        camera = home(self.scene.frame.box, VIEWPORT)
        self.view = self.scene.view(camera, VIEWPORT)
        self.frames = self.scene.settle(self.view)
        self.controls = Controls(self.scene, camera, Style(), 1.0)
        self.session = Session(self.scene, self.controls, self.said.append, folder=str(folder))

    def at(self, row, col):
        """Return the local place of a sample."""
        xy = self.scene.frame.samples_to_local(np.array([row]), np.array([col]))[0]
        return np.array([*xy, 120.0])

    def press(self, *keys):
        for key in keys:
            self.controls.press(key, VIEWPORT)
            self.session.grant(lambda: np.full((3, 4, 3), 7, dtype=np.uint8))

    def finish(self):
        """Let the background end, and hand over each result as a frame does."""
        background = self.session.background
        while background.n_running:
            background._done.put(background._done.get(timeout=60))
            background.poll()


@pytest.fixture
def stage(terrain, tmp_path):
    stage = Stage(terrain, tmp_path)
    yield stage
    stage.session.close()
    stage.scene.close()


def test_a_click_says_coordinates_height_and_bound(stage):
    stage.session.click(stage.at(10, 20))
    stage.finish()
    # Column 20 of 30 m pixels, whose centre is half a pixel in; heights are within 1 m of 120.
    words = stage.said[0].split()
    assert words[:2] == ["500615,", "5199685:"]
    assert abs(float(words[2]) - 120) <= 1
    assert words[3:] == ["m", "±", "1.0", "m"] or words[3:] == ["±", "1.0"]
    assert stage.said[0] in stage.session.lines(stage.frames)
    stage.session.click(None)
    stage.session.click(stage.at(31, 41))
    stage.finish()
    assert stage.said[1].endswith(": no data")


def test_a_profile_is_measured_shown_and_saved(stage, tmp_path):
    stage.press("x", "m")
    assert "nothing is measured" in stage.session.lines(stage.frames)[-1]
    for row, col in ((10, 0), (10, 40), (10, 70), (50, 70)):
        stage.session.click(stage.at(row, col))
    stage.press("backspace")
    stage.finish()
    profile = stage.session.profile
    assert profile.horizontal == pytest.approx(70 * 30)
    assert profile.along_surface == pytest.approx(70 * np.hypot(30, 1), rel=2e-3)
    assert abs(profile.rise - 70) <= 2
    assert any("2,100.0 m horizontal" in line for line in stage.session.lines(stage.frames))
    assert stage.session.line.shape == (71, 3)
    stage.press("x")
    stage.finish()
    (path,) = tmp_path.glob("profile-*.csv")
    lines = path.read_text().splitlines()
    assert lines[0] == "distance_m,x,y,height"
    assert len(lines) == 72
    assert lines[1].startswith("0.000,500015.0,5199685.0,")
    stage.press("m")
    assert stage.session.profile is None


def test_pictures_and_flights_are_saved_under_names_of_their_own(stage, tmp_path):
    stage.press("i", "i")
    stage.finish()
    pictures = sorted(tmp_path.glob("terrainwave-*.png"))
    assert len(pictures) == 2
    with Image.open(pictures[0]) as image:
        assert (image.size, image.getpixel((0, 0))) == ((4, 3), (7, 7, 7))
    stage.press("f")
    stage.controls.press("w", VIEWPORT)
    for _ in range(12):
        stage.session.tick(0.1)
    assert "recording" in " ".join(stage.session.lines(stage.frames))
    stage.press("f")
    (flight,) = tmp_path.glob("flight-*.json")
    cameras = read_flight(flight.read_text(), stage.scene.frame)
    assert len(cameras) == len(json.loads(flight.read_text())) == 3  # at 0, 0.5 and 1 s
    assert cameras[0].position != cameras[2].position


def test_the_ground_is_that_of_the_level_drawn_and_the_last_known_beside_the_raster(stage):
    background = Background()
    ground = Ground(stage.scene.terrain, stage.scene.table, background, clock=lambda: clock[0])
    clock = [0.0]

    def height_at(row, col):
        clock[0] += 1
        x, y, _ = stage.at(row, col)
        camera = Camera((x, y, 620.0))
        ground.height_over(camera, stage.scene.frame)
        while background.n_running:
            background.poll()
        return ground.height_over(camera, stage.scene.frame)

    assert height_at(10, 20) == pytest.approx(500, abs=2)
    last = height_at(10, 70)
    assert last == pytest.approx(450, abs=2)
    assert height_at(500, 500) == last
    background.close()


def test_background_work_has_ended_when_it_is_closed():
    """What it reads is closed next."""
    background = Background(1)
    has_begun, may_end, ended = threading.Event(), threading.Event(), []

    def work():
        has_begun.set()
        may_end.wait(20)
        ended.append(True)

    background.start(work, lambda _: None)
    assert has_begun.wait(20)
    background.close(0.0)  # a silent server's is not waited for
    assert ended == []
    may_end.set()
    background.close()
    assert ended == [True]


def test_the_graph_of_a_profile_lies_below_on_the_left(stage):
    profile = read_profile(
        stage.scene.terrain, Ruler(stage.scene.terrain), [(500015, 5199085), (502200, 5199085)]
    )
    image = draw_overlay(Viewport(640, 480), Camera((0, 0, 0)), [], None, None, profile)
    yellow = np.argwhere((image[..., 0] == 255) & (image[..., 2] == 64))
    assert yellow[:, 0].min() > 320
    assert yellow[:, 1].max() < 520
    rising = [yellow[yellow[:, 1] == col, 0].mean() for col in (100, 400)]
    assert rising[0] > rising[1]


def test_a_line_has_gaps_where_it_is_behind_the_eye_and_dots_at_its_ends():
    pixels = np.array([(10.0, 10.0), (20.0, 10.0), (np.nan, np.nan), (30.0, 20.0)])
    corners = line_triangles(pixels, VIEWPORT)
    assert corners.shape == (3 * (2 + 2 * 2), 2)
    assert line_triangles(np.full((2, 2), np.nan), VIEWPORT).shape == (0, 2)


def test_a_long_help_fits_a_small_window():
    lines = [(f"key {number}", "what it does, in some words") for number in range(26)]
    image = draw_overlay(Viewport(480, 360), Camera((0, 0, 0)), [], None, lines)
    words = np.argwhere((image[..., 0] > 150) & (image[..., 1] > 120) & (image[..., 2] < 150))
    assert len(words)
    assert (words.min(axis=0) > 10).all()
    assert words.max(axis=0)[0] < 350


def test_settings_name_what_was_asked_for_and_what_is(stage):
    found = dict(stage.session.settings(stage.frames, 64 << 20, 512 << 20))
    assert found["mode"] == "adaptive, error measured"
    assert found["memory"] == "64 of 512 MiB on the GPU"
    assert found["threads"] == "2 read and decode"
    assert found["pixel error"].startswith("1 asked")


def test_a_flight_that_cannot_be_saved_is_a_line_and_not_the_end(terrain, tmp_path):
    stage = Stage(terrain, tmp_path / "gone")
    stage.press("f", "f")
    assert "gone" in stage.said[-1]
    assert stage.session.lines(stage.frames) == [stage.said[-1]]
    stage.session.close()
    stage.scene.close()
