"""What tests that draw share: a context of OpenGL, and no error left in it."""

import pytest


@pytest.fixture(scope="module")
def context():
    from terrainwave.render.offscreen import create_context

    context = create_context()
    yield context
    context.release()


@pytest.fixture
def no_gl_errors(context):
    assert context.error == "GL_NO_ERROR"
    yield
    assert context.error == "GL_NO_ERROR"
