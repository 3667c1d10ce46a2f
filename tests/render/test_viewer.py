"""Where a window's events go; the window itself is test_window.py's."""

import pytest

from terrainwave.render.window.viewer import window_config

EVENTS = {
    "on_render": (0.0, 0.1),
    "on_resize": (640, 420),
    "on_key_event": ("p", "press", None),
    "on_mouse_press_event": (3, 4, 1),
    "on_mouse_release_event": (3, 4, 1),
    "on_mouse_drag_event": (3, 4, 1, 1),
    "on_mouse_position_event": (3, 4, 1, 1),
    "on_mouse_scroll_event": (0.0, 1.0),
}


@pytest.mark.parametrize("event", EVENTS)
def test_events_reach_the_viewer_and_are_dropped_before_there_is_one(event):
    config = window_config(object, "hills - terrainwave", (500, 300))()
    getattr(config, event)(*EVENTS[event])
    calls = []

    class Viewer:
        def __getattr__(self, name):
            return lambda *arguments: calls.append(name)

    config.viewer = Viewer()
    getattr(config, event)(*EVENTS[event])
    assert len(calls) == 1
