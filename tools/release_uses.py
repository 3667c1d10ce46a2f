"""Uses of the package, the library and each extra: programs next to ``dem.tif``, ``dem.twz``."""

USES = {
    "core": """
import subprocess, sys
import terrainwave as tw
subprocess.run([sys.executable, "-W", "error", "-c", "import terrainwave"], check=True)
assert tw.compress("dem.tif", "core.twz", max_error=1).measured_error <= 1
with tw.open("core.twz") as terrain:
    assert terrain.read((0, 0, 10, 20)).shape == (10, 20)
""",
    "demo": """
import subprocess
import matplotlib
import terrainwave as tw
matplotlib.use("agg")
subprocess.run(["terrainwave", "demo", "jacksboro"], check=True, stdout=subprocess.DEVNULL)
with tw.open("dem.twz") as terrain:
    terrain.plot().figure.savefig("plot.png")
""",
    "view": """
import subprocess
subprocess.run(["terrainwave", "render", "dem.twz", "seen.png"], check=True)
assert open("seen.png", "rb").read(4) == bytes([137]) + b"PNG"
""",
    "mesh": """
import trimesh
import terrainwave as tw
with tw.open("dem.twz") as terrain:
    mesh = terrain.mesh(max_error=5)
for kind in ("ply", "obj", "stl", "glb", "gltf", "vtu", "terrain"):
    mesh.save(f"used.{kind}")
assert len(trimesh.load_mesh("used.ply").faces) == mesh.n_triangles
""",
    "remote": """
import fsspec
import terrainwave as tw
with fsspec.open("memory://dem.twz", "wb") as file:
    file.write(open("dem.twz", "rb").read())
with tw.open("memory://dem.twz") as far, tw.open("dem.twz") as near:
    assert (far.read() == near.read()).all()
""",
    "distributed": """
from distributed import Client
import terrainwave as tw
if __name__ == "__main__":
    with Client(n_workers=1, threads_per_worker=1, dashboard_address=None) as client:
        tw.compress("dem.tif", "far.twz", max_error=1, client=client)
    tw.compress("dem.tif", "near.twz", max_error=1)
    assert open("far.twz", "rb").read() == open("near.twz", "rb").read()
""",
    "serve": """
import json, subprocess, urllib.request
server = subprocess.Popen(
    ["terrainwave", "serve", "dem.twz", "--port", "0", "--stdin"],
    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
)
address = server.stdout.readline().split(" at ")[1].split()[0]
tiles = json.load(urllib.request.urlopen(address + "dem/tiles.json"))
west, south, east, north = tiles["bounds"]
place = f"dem/height?lon={(west + east) / 2}&lat={(south + north) / 2}"
assert 400 < json.load(urllib.request.urlopen(address + place))["height"] < 900
assert urllib.request.urlopen(address + "dem.tif").read(2) in (b"II", b"MM")
server.stdin.close()
assert server.wait(60) == 0
""",
    "publish": """
import os, subprocess
subprocess.run(["terrainwave", "publish", "dem.twz", "site"], check=True)
assert os.path.getsize("site/index.html") and os.path.getsize("site/dem.twz")
""",
    "notebook": """
import time
import terrainwave as tw
with tw.open("dem.twz") as terrain:
    widget, sent = terrain.explore(), []
    widget._channel._send = lambda content, buffers: sent.append((content, buffers))
    assert "export default" in widget._esm
    widget._handle_custom_msg({"id": "1", "what": "ranges", "ranges": [[0, 100]]}, [])
    widget._handle_custom_msg({"id": "2", "what": "page"}, [])
    while len(sent) < 4:
        time.sleep(0.1)
    found = {content["id"]: buffers for content, buffers in sent if "taken" not in content}
    assert found["1"] == [open("dem.twz", "rb").read(100)] and len(found["2"]) > 20
""",
    "pmtiles": """
import subprocess
subprocess.run(["terrainwave", "tiles", "dem.twz", "dem.pmtiles"], check=True)
assert open("dem.pmtiles", "rb").read(7) == b"PMTiles"
""",
    "library": """
import os, subprocess, sys
read = '''import sys, terrainwave
with terrainwave.open("dem.twz") as terrain:
    print(terrain.read().sum(), terrain.read(level=0).sum(), "numba" in sys.modules)
'''
found = {}
for switch in ("0", "1"):
    environment = {**os.environ, "TERRAINWAVE_NATIVE": switch}
    run = [sys.executable, "-W", "error", "-c", read]
    found[switch] = subprocess.check_output(run, env=environment, text=True).split()
assert found["0"][:2] == found["1"][:2]
assert [one[2] for one in found.values()] == ["True", "False"]
""",
    "xarray": """
import xarray as xr
import terrainwave as tw
with xr.open_dataset("dem.twz") as dataset:
    part = dataset.heights[100:200, 50:150].load()
    dataset.heights.terrainwave.to_twz("again.twz", max_error=1)
with tw.open("dem.twz") as terrain:
    assert (part.values == terrain.read((100, 50, 100, 100))).all()
""",
    "zarr": """
import numpy as np, zarr
import terrainwave as tw
from terrainwave.ext.zarr_codec import TerrainwaveCodec
with tw.open("dem.twz") as terrain:
    heights = terrain.read()
array = zarr.create_array(
    "dem.zarr", shape=heights.shape, chunks=(128, 128), dtype=heights.dtype,
    serializer=TerrainwaveCodec(max_error=1), compressors=None,
)
array[:] = heights
assert abs(zarr.open_array("dem.zarr")[:] - heights).max() <= 1
""",
    "pyvista": """
import pyvista
surface = pyvista.read("dem.twz")
assert surface.n_cells > 100 and "heights" in surface.point_data
""",
}

# For mypy: all is right but the last line.
TYPED = """\
import terrainwave as tw
terrain = tw.open("dem.twz")
error: float = terrain.effective_error
heights: str = terrain.read()
"""
