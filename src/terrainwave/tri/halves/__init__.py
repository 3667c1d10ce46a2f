"""Default triangulation: triangles halved until all samples are within the tolerance."""
