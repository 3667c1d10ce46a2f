"""What tests that draw share: a context of OpenGL, and no error left in it."""

import numpy as np
import pytest
from render.scenes import hills, terrain_of

from terrainwave.render.modes.dynamic import Dynamic
from terrainwave.render.modes.rqt import RqtMode


@pytest.fixture(scope="module")
def context():
    from terrainwave.render.gpu.canvas import create_context

    context = create_context()
    yield context
    context.release()


@pytest.fixture
def no_gl_errors(context):
    assert context.error == "GL_NO_ERROR"
    yield
    assert context.error == "GL_NO_ERROR"


@pytest.fixture(scope="module")
def gentle():
    """A terrain whose levels are good enough side by side."""
    heights = np.round(hills(200, 220, 3, amplitude=60)).astype(np.int16)
    with terrain_of(heights, max_error=0) as terrain:
        yield terrain


@pytest.fixture
def small_patches(monkeypatch):
    """As if patches that follow the camera were so small that a small file has many."""
    monkeypatch.setattr(RqtMode, "cells", 32)
    for name, value in (("tree", 4), ("samples", 36)):
        monkeypatch.setattr(Dynamic, name, value)
