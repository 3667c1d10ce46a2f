"""Cameras, pieces, their selection and geometry. Numbers only."""
