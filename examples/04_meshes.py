"""Mesh an area within a bound, write it for other programs, make a printable body of it."""

import tempfile
from pathlib import Path

import matplotlib.cbook

import terrainwave as tw

with matplotlib.cbook.get_sample_data("jacksboro_fault_dem.npz") as dem:
    heights = dem["elevation"]

with tempfile.TemporaryDirectory() as directory:
    path = Path(directory) / "jacksboro.twz"
    tw.compress(heights, path, max_error=1, block=32)
    with tw.open(path) as terrain:
        mesh = terrain.mesh(max_error=30)
        print(f"{mesh.n_triangles} triangles, no height further than {mesh.error:g} from it")
        small = terrain.mesh(max_triangles=2000)
        print(f"{small.n_triangles} triangles do for {small.error:g}")
    # Pixels are the only unit of an array's columns and rows: one is taken for 80 m here.
    saved = mesh.save(Path(directory) / "jacksboro.ply", frame="native", z_scale=1 / 80)
    print(f"PLY: {saved.n_bytes} bytes, error in the file {saved.error:g}")
    body = small.save(Path(directory) / "model.stl", frame="native", z_scale=1 / 80, solid=0)
    print(f"STL: {body.n_triangles} triangles with walls and base")
