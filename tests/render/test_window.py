"""The window under Xvfb, driven by xdotool; and what is said where there is no display."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from commands import python, python_with
from render.scenes import hills

from terrainwave.write.compress import compress

pytestmark = [pytest.mark.gl, pytest.mark.large, pytest.mark.full]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("window") / "hills.twz"
    compress(np.round(hills(150, 210, 1)).astype(np.int16), path, block=32)
    return path


DRIVER = """
set -u
cd {folder}
{python} -m terrainwave view {file} --size 500x300 > {folder}/out.txt 2> {folder}/err.txt &
pid=$!
for _ in $(seq 300); do
    window=$(xdotool search --onlyvisible --name terrainwave 2>/dev/null | head -1)
    [ -n "$window" ] && break
    kill -0 $pid 2>/dev/null || break
    sleep 0.1
done
xdotool windowfocus --sync $window 2>/dev/null
wait_for() {{  # until the viewer has printed $1 cameras
    for _ in $(seq 200); do
        xdotool key p
        sleep 0.15
        [ "$(grep -c camera {folder}/out.txt)" -ge $1 ] && break
    done
}}
wait_for 1
xdotool keydown w; sleep 0.6; xdotool keyup w
wait_for $(( $(grep -c camera {folder}/out.txt) + 1 ))
xdotool windowsize --sync $window 640 420
sleep 0.7
xdotool key t
sleep 0.5
for _ in $(seq 100); do  # until the click's height has been read
    xdotool mousemove --window $window 320 210 click 1
    sleep 0.3
    grep -q '±' {folder}/out.txt && break
done
xdotool key i f
sleep 0.7
xdotool key f
for _ in $(seq 100); do  # until both have been written
    ls {folder}/terrainwave-*.png {folder}/flight-*.json > /dev/null 2>&1 && break
    sleep 0.1
done
xdotool mousemove --window $window 320 210 mousedown 1
xdotool mousemove --window $window 380 210
sleep 0.3
xdotool mousemove --window $window 420 210 mouseup 1
xdotool key h
sleep 0.7
{python} -c "from PIL import ImageGrab; ImageGrab.grab().save('{folder}/screen.png')"
xdotool key Escape
wait $pid
echo "status $?"
"""


def numbers(line):
    return [float(part) for part in re.search(r"--camera (\S+)", line)[1].split(",")]


def test_keys_and_mouse_move_the_camera_and_escape_closes(file, tmp_path):
    script = DRIVER.format(python=sys.executable, file=file, folder=tmp_path)
    done = subprocess.run(
        ["xvfb-run", "-a", "-s", "-screen 0 800x600x24 +extension GLX", "bash", "-c", script],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    errors = (tmp_path / "err.txt").read_text()
    assert "status 0" in done.stdout, done.stdout + done.stderr + errors
    said = (tmp_path / "out.txt").read_text().splitlines()
    cameras = [numbers(line) for line in said if line.startswith("--camera")]
    first, flown, last = cameras[0], cameras[-2], cameras[-1]
    assert flown[1] > first[1]  # W: north, as it looked
    assert flown[3] == first[3]
    assert last[3] != flown[3]  # dragging turned it
    assert any(line.endswith("± 0") for line in said), said  # the click
    assert len(json.loads(next(tmp_path.glob("flight-*.json")).read_text())) >= 1
    from PIL import Image

    with Image.open(next(tmp_path.glob("terrainwave-*.png"))) as image:
        assert image.size == (640, 420)
    with Image.open(tmp_path / "screen.png") as image:
        screen = np.asarray(image.convert("RGB")).astype(int)
    # The window has grown, and shows more than one colour in its new part.
    assert len(np.unique(screen[310:400, :600].reshape(-1, 3), axis=0)) > 1
    assert screen[:420, :640].any(axis=2).mean() > 0.95
    assert not screen[460:, 700:].any()


def test_without_a_display_one_line_names_render_and_what_to_install(file):
    without = {name: value for name, value in os.environ.items() if "DISPLAY" not in name}
    done = python_with(["-m", "terrainwave", "view", file], env=without)
    assert done.returncode == 1
    lines = [line for line in done.stderr.splitlines() if not line.startswith("compiling")]
    assert len(lines) == 1
    assert "terrainwave render" in lines[0]
    assert "apt-get install" in lines[0]


def test_drawing_for_long_keeps_memory_flat(file):
    """1000 frames with paging leave at most 20 MiB, less than a third of their pictures.

    The software renderer keeps and frees up to 70 MiB between frames, so the least of ten
    sizes is compared, each after the heap was given back.
    """
    code = f"""
import ctypes
import resource
import terrainwave
from terrainwave.render.gpu.arena import Arena
from terrainwave.render.scene.camera import Camera
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
sizes, drops = [], []
with terrainwave.open({str(file)!r}, cache_bytes=1 << 20, threads=1) as terrain:
    with Canvas(terrain, (160, 120), samples=0, max_bytes=64 << 20) as canvas:
        store, scene = canvas.store, canvas.scene
        layers, drop = store.layers, store.drop
        layers.max_layers, layers._free = 24, Arena(24)
        store.drop = lambda node: (drops.append(node), drop(node))
        low, high = scene.frame.box
        for number in range(1000):
            share = number % 200 / 200
            camera = Camera((low[0] + share * (high[0] - low[0]), low[1], high[2] + 20.0),
                            (number * 7 % 120 - 60) % 360, -30.0, 50.0)
            canvas.draw(camera, Style(), settle=False)
            scene._pager.wait(0.01)
            assert store.n_bytes <= 64 << 20
            if number % 50 == 49:
                ctypes.CDLL(None).malloc_trim(0)
                pages = int(open("/proc/self/statm").read().split()[1])
                sizes.append(pages * resource.getpagesize() / 2**20)
        assert canvas.context.error == "GL_NO_ERROR"
assert len(drops) > 150, len(drops)
print(*sizes)
"""
    done = python(code)
    assert done.returncode == 0, done.stderr
    sizes = [float(size) for size in done.stdout.split()]
    assert min(sizes[10:]) < min(sizes[:10]) + 20, sizes
