"""Has the validator of glTF's authors anything to say about our files? Nothing, hints included."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from ext.rasters import hills, write_twz
from PIL import Image

import terrainwave

HERE = Path(__file__).parent
# Prints the list of messages for each file.
VALIDATE = """
const { validateBytes } = require("gltf-validator");
const { readFileSync } = require("fs");
(async () => {
  const found = [];
  for (const path of process.argv.slice(1)) {
    found.push((await validateBytes(new Uint8Array(readFileSync(path)))).issues.messages);
  }
  console.log(JSON.stringify(found));
})();
"""

pytestmark = pytest.mark.full


def messages(*paths):
    command = ["node", "-e", VALIDATE, *map(str, paths)]
    done = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hills")
    return write_twz(folder, hills(120, 131) * 4, (8.0, 46.0, 8.3, 46.2), max_error=1, block=32)


@pytest.mark.parametrize(
    ("ending", "is_draped", "options"),
    [
        ("glb", True, {}), ("gltf", False, {"skirts": 9.0}), ("gltf", False, {"solid": -99.0}),
        ("glb", True, {"frame": "ecef"}),
    ],
)  # fmt: skip
def test_a_set_of_levels_of_detail_is_valid_without_a_message(
    tmp_path, twz, ending, options, is_draped
):
    if is_draped:
        noise = np.random.default_rng(1).integers(0, 256, (31, 45, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "plain.png")
        options = options | {"drape": tmp_path / "plain.png"}
    saved = terrainwave.save_lods(twz, tmp_path / f"a.{ending}", 4, max_error=2, **options)
    assert messages(*(one.path for one in saved)) == [[]] * 4


def test_the_validator_finds_what_is_wrong(tmp_path, twz):
    """A test that cannot fail is none."""
    (saved,) = terrainwave.save_lods(twz, tmp_path / "a.gltf", 1, max_error=2)
    document = json.loads(Path(saved.path).read_text())
    del document["bufferViews"][0]["target"]
    Path(saved.path).write_text(json.dumps(document))
    (found,) = messages(saved.path)
    assert [one["code"] for one in found] == ["BUFFER_VIEW_TARGET_MISSING"]
