"""Drawing with OpenGL, by moderngl."""
