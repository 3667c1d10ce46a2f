"""Requests of a viewer's user besides the picture, and messages."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import TerrainwaveError
from terrainwave.render.look.png import encode_png
from terrainwave.render.modes.mode import Frames
from terrainwave.render.paging.background import Background, Outcome
from terrainwave.render.paging.problems import replies_of
from terrainwave.render.paging.read_ahead import PATIENCE
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import format_camera
from terrainwave.render.scene.measure import (
    Profile,
    Ruler,
    describe_place,
    describe_profile,
    read_profile,
)
from terrainwave.render.window.captures import FlightRecorder, save_as_new
from terrainwave.render.window.controls import Controls
from terrainwave.render.window.ground import Ground

_NOTE_SECONDS = 6.0


class Session:
    """Clicks, measurements, captures and messages. Used by one thread, which never waits."""

    def __init__(
        self,
        scene: Scene,
        controls: Controls,
        say: Callable[[str], None],  # called with lines for stdout
        *,
        radius: float | None = None,  # of the body in metres, for degrees
        folder: str = ".",  # directory for written files
    ) -> None:
        self._scene, self.controls, self._say, self._folder = scene, controls, say, folder
        # `background, slow`: work for clicks and keys, and separately for anything slower, so that
        # answers do not wait for it
        self.background, self.slow = Background(), Background()
        table = scene.table if hasattr(scene.mode, "builder") else None
        self._ground = Ground(scene.terrain, table, self.background)
        self._ruler = Ruler(scene.terrain, radius)
        self._points: list[tuple[float, float]] = []
        self.profile: Profile | None = None
        self._place_line = ""
        self._recorder: FlightRecorder | None = None
        self._notes: list[tuple[float, str]] = []

    def close(self) -> None:
        """Save a flight being recorded; start no more work, and wait for running work."""
        if self._recorder is not None:
            self._end_flight()
        # A silent server would delay the end.
        patience = None if replies_of(self._scene.terrain) is None else PATIENCE
        self.background.close(patience)
        self.slow.close(patience)

    @property
    def camera_line(self) -> str:
        return format_camera(self.controls.camera, self._scene.frame)

    def tick(self, seconds: float) -> None:
        """Take results, move on, and record, for the time since the last frame."""
        self.background.poll()
        self.slow.poll()
        controls = self.controls
        controls.height_over_ground = self._ground.height_over(controls.camera, self._scene.frame)
        controls.tick(seconds)
        if self._recorder is not None:
            self._recorder.tick(seconds, self.camera_line)

    def grant(self, grab: Callable[[], NDArray[np.uint8]]) -> None:
        """Fulfil requests of keys; `grab` returns the picture, uint8 (height, width, 3)."""
        wishes, self.controls.wishes = self.controls.wishes, []
        for wish in wishes:
            if wish == "camera":
                self._say(f"--camera {self.camera_line}")
            elif wish == "picture":
                self._save("terrainwave", ".png", partial(encode_png, grab()))
            elif wish == "flight":
                self._toggle_flight()
            elif wish == "profile":
                self._save_profile()
            elif wish == "measure":
                self._points, self.profile = [], None
            elif wish == "undo":
                self._points = self._points[:-1]
                self._measure()

    def click(self, point: NDArray[np.float64] | None) -> None:
        """Handle a click on a point of the surface, local metres; None: on the sky."""
        if point is None:
            return
        x, y, _ = self._scene.frame.to_world(point[None])[0].tolist()
        if self.controls.is_measuring:
            self._points.append((x, y))
            self._measure()
            return
        terrain = self._scene.terrain
        self._place_line = f"{x:.10g}, {y:.10g}: reading"

        def show(outcome: Outcome) -> None:
            self._place_line = outcome.problem or describe_place(terrain, x, y, outcome.value)
            self._say(self._place_line)

        self.background.start(lambda: float(terrain.sample([(x, y)])[0]), show)

    def _measure(self) -> None:
        points = list(self._points)
        if len(points) < 2:
            self.profile = None
            return

        def show(outcome: Outcome) -> None:
            if points != self._points:
                return  # the points have changed meanwhile
            self.profile = outcome.value
            if outcome.problem is not None:
                self.note(outcome.problem)
            else:
                for line in describe_profile(self._scene.terrain, outcome.value):
                    self._say(line)

        terrain, ruler = self._scene.terrain, self._ruler
        self.background.start(lambda: read_profile(terrain, ruler, points), show)

    @property
    def line(self) -> NDArray[np.float64]:
        """Return the measured line as local metres, shape (n, 3), to draw over the picture."""
        frame = self._scene.frame
        if self.profile is not None:
            heights = self.profile.heights
            here = ~np.isnan(heights)
            return frame.to_local(np.column_stack([self.profile.places[here], heights[here]]))
        if not self._points:
            return np.empty((0, 3))
        heights = np.full(len(self._points), np.mean(frame.heights))
        return frame.to_local(np.column_stack([np.array(self._points), heights]))

    def _save(self, stem: str, ending: str, data: Callable[[], bytes]) -> None:
        def show(outcome: Outcome) -> None:
            line = outcome.problem or f"saved {outcome.value}"
            self.note(line)
            self._say(line)

        folder = self._folder
        self.background.start(lambda: save_as_new(data(), stem, ending, folder), show)

    def _toggle_flight(self) -> None:
        if self._recorder is None:
            self._recorder = FlightRecorder()
            self._recorder.tick(0.0, self.camera_line)
        else:
            self._end_flight()

    def _end_flight(self) -> None:
        recorder, self._recorder = self._recorder, None
        assert recorder is not None
        try:
            name = save_as_new(recorder.to_json().encode(), "flight", ".json", self._folder)
        except TerrainwaveError as error:  # the window stays open
            self.note(str(error))
            self._say(str(error))
            return
        frames = max(round(recorder.seconds * 30), 2)
        self.note(f"saved {name}")
        self._say(
            f"saved {name}: terrainwave render FILE PICTURE.png --flight {name} --frames {frames}"
        )

    def _save_profile(self) -> None:
        if self.profile is None:
            self.note("nothing is measured: M, then click two places or more")
            return
        table = self.profile.csv().encode()
        self._save("profile", ".csv", lambda: table)

    def note(self, line: str) -> None:
        self._notes.append((time.monotonic() + _NOTE_SECONDS, line))

    def lines(self, frames: Frames) -> list[str]:
        now = time.monotonic()
        self._notes = [(until, line) for until, line in self._notes if until > now]
        lines = self._scene.problems.lines(frames.n_missing)
        if self._recorder is not None:
            lines.append(f"recording the flight, {self._recorder.seconds:.0f} s: F ends and saves")
        if self.controls.is_measuring:
            if self.profile is not None:
                lines += describe_profile(self._scene.terrain, self.profile)
            elif len(self._points) > 1:
                lines.append("reading the profile")
            else:
                lines.append("measure: click two places or more; M ends, X saves the profile")
        elif self._place_line:
            lines.append(self._place_line)
        return lines + [line for _, line in self._notes]

    def settings(self, frames: Frames, n_bytes: int, max_bytes: int) -> list[tuple[str, str]]:
        """Return the current settings, named and written out, for the help."""
        scene, controls = self._scene, self.controls
        style, mode = controls.style, scene.mode
        ramp = "" if style.is_absolute(scene.frame.body) else f", {style.ramp_on(scene.frame.body)}"
        kept = f"{frames.tau:.3g} drawn" if mode.has_limit else "no limit"
        found: dict[str, Any] = {
            "mode": f"{mode.name}, error {mode.error}",
            "pixel error": f"{controls.max_pixel_error:.3g} asked, {kept}",
            "exaggeration": f"{scene.frame.exaggeration:.3g}",
            "coloring": style.coloring + ramp,
            "sun, haze": f"{style.sun[0]:g}°, {style.sun[1]:g}° high; {style.haze:g}",
            "memory": f"{n_bytes / 2**20:.0f} of {max_bytes >> 20} MiB on the GPU",
            "threads": f"{scene.n_workers} read and decode",
            "file": f"{scene.terrain.name}, within {scene.terrain.effective_error:g}"
            f" {scene.terrain.units or ''}".rstrip(),
        }
        found |= {name: f"{value:g}" for name, value in scene.options.items() if value}
        return [(name, str(value)) for name, value in found.items()]
