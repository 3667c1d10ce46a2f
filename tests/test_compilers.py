"""Do kernels of both compilers, numba's own and ours, read and write the same bytes?"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
WORKER = """
import sys
sys.path[:0] = ["src", "tests", "tools", "."]
from benchmarks import same_bytes_worker
same_bytes_worker.main("2", *sys.argv[1:])
from terrainwave.coding.compiled import COMPILER
print(COMPILER)
"""


@pytest.mark.full
@pytest.mark.large
def test_golden_files_are_read_and_written_alike_by_both_compilers(tmp_path):
    found = {}
    for compiler in ("fast", "plain"):
        result = tmp_path / f"{compiler}.json"
        done = subprocess.run(
            [sys.executable, "-c", WORKER, str(tmp_path), str(result)],
            env={**os.environ, "TERRAINWAVE_COMPILER": compiler},
            cwd=ROOT, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines()[-1] == compiler
        found[compiler] = json.loads(result.read_text(encoding="utf-8"))
        assert len(found[compiler]["decoded"]) > 40
        wrong = [name for name, is_equal in found[compiler]["decoded"].items() if not is_equal]
        assert wrong == []
    assert len(found["fast"]["written"]) > 30
    assert found["fast"]["written"] == found["plain"]["written"]
