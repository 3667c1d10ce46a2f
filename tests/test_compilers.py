"""Do kernels of numba's own compiler read and write the bytes that ours do?"""

import json
from pathlib import Path

import pytest
from commands import environment, python

ROOT = Path(__file__).parent.parent
# The method and mesh of the default; the workflow `next` runs all tests so.
NAMES = ("rapid-int16-halves",)
WORKER = """
import json, sys
from pathlib import Path
sys.path[:0] = ["src", "tests", "tools", "."]
import golden_files, make_golden
from terrainwave.coding.compiled import COMPILER
folder, *names = sys.argv[1:]
found = {"compiler": COMPILER, "decoded": {}, "written": {}}
for name in names:
    target = Path(folder, f"{name}.twz")
    make_golden.write_case(target, *make_golden.CASES[name])
    found["written"][name] = golden_files.sha256(target)
    found["decoded"][name] = golden_files.found(golden_files.GOLDEN / "v2" / target.name)
    target.unlink()
print(json.dumps(found))
"""


@pytest.mark.full
def test_golden_files_are_read_and_written_alike_by_both_compilers(tmp_path):
    found = {}
    for compiler in ("fast", "plain"):
        chosen = environment(TERRAINWAVE_COMPILER=compiler)
        done = python(WORKER, tmp_path, *NAMES, env=chosen, cwd=ROOT, timeout=None)
        assert done.returncode == 0, done.stderr
        found[compiler] = json.loads(done.stdout.splitlines()[-1])
        assert found[compiler].pop("compiler") == compiler
    assert found["fast"] == found["plain"]
    expected = json.loads((ROOT / "tests/golden/v2/manifest.json").read_text("utf-8"))["files"]
    for name, decoded in found["plain"]["decoded"].items():
        assert decoded.items() <= expected[f"{name}.twz"].items()
