"""A quadtree of heights that follows a camera, by Haar coefficients."""
