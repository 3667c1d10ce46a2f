"""The window of `terrainwave view`."""

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from terrainwave.errors import TerrainwaveError
from terrainwave.extras import need
from terrainwave.file import TerrainFile
from terrainwave.render import DEFAULT_MAX_BYTES
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.drape_detail import DrapeDetail
from terrainwave.render.look.style import Style
from terrainwave.render.look.water import may_have_water, read_water
from terrainwave.render.modes.mode import NO_PROMISE, Frames
from terrainwave.render.paging.background import Background, Outcome
from terrainwave.render.paging.problems import replies_of
from terrainwave.render.scene.frame import check_drawable
from terrainwave.render.scene.walls import build_solid
from terrainwave.render.window.controls import HELP, Controls
from terrainwave.render.window.pictures import area_within, choose_camera
from terrainwave.render.window.session import Session

_OVERLAY_SECONDS = 0.2
_SOLID_PAUSE = 5.0
_NO_WINDOW = (
    "cannot open a window ({problem}); a picture needs none: terrainwave render FILE PICTURE.png;"
    " a window needs a display and OpenGL 3.3, on Debian and Ubuntu: apt-get install libgl1"
    " libgl1-mesa-dri libglu1-mesa libx11-6"
)


def _display_problem(line: str) -> str:
    """Return the problem of the display; X's own message does not name the display."""
    if "cannot connect to" not in line.lower():
        return line[:200]
    display = os.environ.get("DISPLAY")
    if not display:
        return "found no DISPLAY in the environment, expected that of an X server"
    return f"no X server answers for DISPLAY {display[:100]}"


def run(
    terrain: TerrainFile,
    *,
    size: tuple[int, int],
    camera: str | None,
    bounds: Sequence[float] | None = None,
    style: Style,
    max_pixel_error: float,
    max_bytes: int = DEFAULT_MAX_BYTES,
    fullscreen: bool = False,
    **options: Any,
) -> str:
    """Show a terrain until the window is closed; return the last camera as a line."""
    check_drawable(terrain)
    area = None if bounds is None else area_within(terrain, bounds)
    toolkit: Any = need("moderngl_window", extra="view", purpose="a window")

    arguments = ["--vsync", "true"] + (["--fullscreen"] if fullscreen else [])
    try:
        config = toolkit.create_window_config_instance(
            window_config(toolkit.WindowConfig, f"{terrain.name} - terrainwave", size),
            args=arguments,
        )
    except Exception as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise TerrainwaveError(_NO_WINDOW.format(problem=_display_problem(lines[0]))) from error
    with ExitStack() as stack:
        # In this order, even after an error: threads read from objects that the canvas and the
        # terrain close.
        stack.callback(config.wnd.destroy)
        canvas = stack.enter_context(
            Canvas(
                terrain,
                config.wnd.buffer_size,
                context=config.ctx,
                max_bytes=max_bytes,
                is_late=True,
                retries=True,
                **options,
            )
        )
        style.check_body(canvas.scene.frame.body)
        first = choose_camera(canvas.scene.frame, canvas.viewport, camera, area)
        controls = Controls(canvas.scene, first, style, max_pixel_error)
        session = Session(canvas.scene, controls, _say, radius=options.get("radius"))
        stack.callback(session.close)
        viewer = config.viewer = Viewer(config.wnd, canvas, session, max_bytes)
        stack.callback(viewer.close)
        _loop(config, viewer)
        return session.camera_line


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


# Handlers of a window's events; they get the viewer first.
_EVENTS: dict[str, Callable[..., None]] = {
    "on_render": lambda viewer, time, frame_time: viewer.render(frame_time),
    "on_resize": lambda viewer, width, height: viewer.resize(),
    "on_key_event": lambda viewer, key, action, modifiers: viewer.key(key, action),
    "on_mouse_press_event": lambda viewer, x, y, button: viewer.press(x, y),
    "on_mouse_release_event": lambda viewer, x, y, button: viewer.release(x, y),
    "on_mouse_drag_event": lambda viewer, x, y, dx, dy: viewer.drag(dx, dy),
    "on_mouse_position_event": lambda viewer, x, y, dx, dy: viewer.move(x, y),
    "on_mouse_scroll_event": lambda viewer, x_offset, y_offset: viewer.scroll(y_offset),
}


def window_config(base: Any, caption: str, size: tuple[int, int]) -> Any:
    """Return the class of a window with this title, derived from moderngl_window's.

    Events also arrive while the window opens (the pointer lies where it appears, a key is down),
    before there is a ``viewer`` to handle them: those are dropped.
    """

    def handler(name: str) -> Callable[..., None]:
        def handle(config: Any, *given: Any) -> None:
            if config.viewer:
                _EVENTS[name](config.viewer, *given)

        return handle

    options = {
        "gl_version": (3, 3), "title": caption, "window_size": size, "aspect_ratio": None,
        "resizable": True, "samples": 0, "clear_color": None, "log_level": 40, "viewer": None,
    }  # fmt: skip
    return type("Config", (base,), options | {name: handler(name) for name in _EVENTS})


def _loop(config: Any, viewer: "Viewer") -> None:
    """Draw until the window closes; the caller destroys the window, after its content."""
    window, timer = config.wnd, config.timer
    timer.start()
    while not window.is_closing:
        current, delta = timer.next_frame()
        window.use()
        window.render(current, delta)
        if viewer.controls.is_closing:
            window.close()
        if not window.is_closing:
            window.swap_buffers()


class Viewer:
    """A window's content: scene, session, overlay."""

    def __init__(self, window: Any, canvas: Canvas, session: Session, max_bytes: int) -> None:
        self._window = window
        self._canvas = canvas
        self._session, self.controls, self._max_bytes = session, session.controls, max_bytes
        from terrainwave.render.gpu.overlay import Overlay  # imported late: moderngl

        self.overlay = Overlay(canvas.context)
        self.cursor = (0, 0)
        self._times: deque[float] = deque(maxlen=60)
        self._ink = Background(1)  # draws the overlay, which takes longer than a frame
        self._drawn: Any = None
        self._overlay_time = 0.0
        self._keys = _key_names(window.keys)
        self._solid_at = self._first_seen = 0.0
        self._wants_solid = True
        self._wants_drape = canvas.photo is not None
        scene = canvas.scene
        self._wants_water = may_have_water(scene.terrain, scene.frame)
        self._detail: DrapeDetail | None = None

    def render(self, frame_time: float) -> None:
        started = time.perf_counter()
        controls, canvas = self.controls, self._canvas
        size = canvas.viewport.width, canvas.viewport.height
        if size != self._window.buffer_size:
            self.resize()
        self._session.tick(frame_time)
        self._ink.poll()
        frames = canvas.draw(
            controls.camera,
            controls.style,
            max_pixel_error=controls.max_pixel_error,
            settle=canvas.scene.mode.is_partwise,
        )
        if self._wants_solid and started > self._solid_at and self._is_at_rest(frames):
            self._read_solid()
        if self._wants_water and len(frames.nodes):
            self._read_water()
        if self._wants_drape and len(frames.nodes):
            self._read_drape()
        if self._detail is not None:
            height = controls.height_over_ground
            self._detail.tick(controls.camera, height, canvas.scene.frame)
        canvas.context.copy_framebuffer(self._window.fbo, canvas.framebuffer)
        self._window.use()
        self._times.append(frame_time)
        if time.perf_counter() - self._overlay_time > _OVERLAY_SECONDS:
            self._update_overlay(frames)
        line = self._session.line
        if len(line):
            self.overlay.draw_line(line, controls.camera, canvas.viewport)
        self.overlay.draw()
        canvas.scene.governor.after_frame((time.perf_counter() - started) * 1e3)

    def _start(
        self,
        work: Callable[[], Any],
        show: Callable[[Any], None],
        note: Callable[[str], None] | None = None,
    ) -> None:
        """Show the result of `work` in the background; `note` its problem, by default as a line."""

        def take(outcome: Outcome) -> None:
            if outcome.problem is None:
                show(outcome.value)
            else:
                (note or self._session.note)(outcome.problem)

        self._session.slow.start(work, take)

    def _read_drape(self) -> None:
        """Read the orthophoto, first as a whole, then finer near the camera."""
        canvas, self._wants_drape = self._canvas, False
        assert canvas.photo is not None
        self._detail = DrapeDetail(
            canvas.photo,
            canvas.drape_texels_per_pixel,
            self._session.slow,
            canvas.renderer.set_detail,
        )
        self._start(canvas.read_drape, canvas.renderer.set_drape)

    def _read_water(self) -> None:
        self._wants_water, scene = False, self._canvas.scene
        self._start(lambda: read_water(scene.terrain, scene.frame), self._canvas.renderer.set_water)

    def _is_at_rest(self, frames: Frames) -> bool:
        """Return whether reading the block under the terrain delays no part of the terrain."""
        if not len(frames.nodes):
            return False
        self._first_seen = self._first_seen or time.perf_counter()
        is_remote = replies_of(self._canvas.scene.terrain) is not None
        has_waited = time.perf_counter() - self._first_seen > _SOLID_PAUSE
        return has_waited or not (is_remote and frames.n_missing)

    def _read_solid(self) -> None:
        """Read the block under the terrain; again later, if that fails."""
        self._wants_solid, scene = False, self._canvas.scene

        def wait(_: str) -> None:
            self._wants_solid, self._solid_at = True, time.perf_counter() + _SOLID_PAUSE

        self._start(lambda: build_solid(scene.terrain, scene.frame), self._canvas.set_solid, wait)

    def close(self) -> None:
        self._ink.close()
        self.overlay.release()

    def resize(self) -> None:
        width, height = self._window.buffer_size
        if width > 0 and height > 0:
            self._canvas.resize((width, height))
            self._overlay_time = 0.0

    def key(self, key: Any, action: Any) -> None:
        name = self._keys.get(key)
        if name is None:
            return
        if action == self._window.keys.ACTION_PRESS:
            self.controls.press(name, self._canvas.viewport)
            self._session.grant(self._canvas.grab)
            self._overlay_time = 0.0
        else:
            self.controls.release(name)

    def move(self, x: float, y: float) -> None:
        self.cursor = int(x), int(y)

    def press(self, x: float, y: float) -> None:
        self.move(x, y)
        self.controls.grab(self._pick(x, y))

    def release(self, x: float, y: float) -> None:
        """Handle a released mouse button: a click, unless it has dragged."""
        if self.controls.was_click:
            self._session.click(self._pick(x, y))
            self._overlay_time = 0.0

    def drag(self, dx: float, dy: float) -> None:
        self.controls.drag(dx, dy, is_right=bool(self._window.mouse_states.right))

    def scroll(self, notches: float) -> None:
        self.controls.scroll(notches, self._pick(*self.cursor))

    def _pick(self, x: float, y: float) -> Any:
        ratio = self._window.pixel_ratio
        return self._canvas.pick(x * ratio, y * ratio)

    def _update_overlay(self, frames: Frames) -> None:
        from terrainwave.render.gpu.overlay import (  # imported late: moderngl
            Change,
            change_of,
            draw_overlay,
        )

        self._overlay_time = time.perf_counter()
        if self._ink.n_running:
            return
        canvas, controls = self._canvas, self.controls
        viewport, scene = canvas.viewport, canvas.scene
        seconds = float(np.mean(self._times)) if self._times else 0.0
        raised = "" if frames.tau <= controls.max_pixel_error * 1.01 else " (raised)"
        within = f"within {frames.tau:.2g} pixels{raised}"
        if not (scene.mode.has_limit and frames.tau < NO_PROMISE):
            within = "no limit in pixels"
        loading = f", {frames.n_missing} to come" if frames.n_missing else ""
        lines = [
            f"{1 / max(seconds, 1e-6):.0f} fps, {frames.n_triangles:,} triangles in"
            f" {len(frames.nodes)} blocks{loading}",
            f"GPU {canvas.n_bytes / 2**20:.0f} MiB, {within}",
        ]
        lines += [f"speed {controls.speed:.3g} m/s"] if controls.is_flying else []
        under = self._pick(*self.cursor)
        if under is not None:
            x, y, z = scene.frame.to_world(under[None])[0]
            unit = scene.terrain.units or ""
            lines.append(f"{x:.10g}, {y:.10g}: {z:.6g} {unit}".rstrip())
        lines += self._session.lines(frames)
        if canvas.photo is not None and canvas.photo.credit is not None:
            lines.append(f"tiles: {canvas.photo.credit}")
        lines.append("H: help")
        shown = None
        if controls.shows_help:
            found = self._session.settings(frames, canvas.n_bytes, self._max_bytes)
            shown = [*HELP, ("", ""), *found]
        scale = canvas.metres_per_pixel()
        camera, profile = controls.camera, self._session.profile
        before = self._drawn

        def draw() -> Change:
            image = draw_overlay(viewport, camera, lines, scale, shown, profile)
            return change_of(before, image)

        def take(outcome: Outcome) -> None:
            self.overlay.set(outcome.value)
            self._drawn = outcome.value.image

        self._ink.start(draw, take)


def _key_names(keys: Any) -> dict[Any, str]:
    """Map a backend's key codes to the names in `Controls`."""
    names = {getattr(keys, letter.upper()): letter for letter in "abcdefhilmnopqrstwx"}
    others = {
        "ESCAPE": "escape", "BACKSPACE": "backspace", "TAB": "tab", "HOME": "home",
        "COMMA": "comma", "PERIOD": "period",
        "LEFT_BRACKET": "[", "RIGHT_BRACKET": "]", "MINUS": "-", "EQUAL": "+",
        "LEFT_SHIFT": "shift", "RIGHT_SHIFT": "shift", "UP": "w", "DOWN": "s",
        "LEFT": "a", "RIGHT": "d", "PAGE_UP": "e", "PAGE_DOWN": "q",
    }  # fmt: skip
    for code, name in others.items():
        if hasattr(keys, code):
            names[getattr(keys, code)] = name
    return names
