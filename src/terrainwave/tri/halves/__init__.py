"""The default triangulation: triangles halved until all samples are near."""
