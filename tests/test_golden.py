"""Do files of every released version decode to the same, and are invalid ones rejected?"""

import json
import re
import subprocess
import sys
import zipfile

import pytest
from conformance import invalid, library, reference
from golden_files import GOLDEN, found, found_invalid

from terrainwave.annexes import read_annex
from terrainwave.container.header import FORMAT_VERSION

sys.path.append(str(GOLDEN.parents[1] / "tools"))
import make_conformance
import run_conformance

DOCS = GOLDEN.parents[1] / "docs"
MANIFESTS = {
    path.parent.name: json.loads(path.read_text(encoding="utf-8"))
    for path in sorted(GOLDEN.glob("v*/manifest.json"))
}
FILES = [(version, name) for version, found in MANIFESTS.items() for name in found["files"]]
INVALID = [(version, name) for version, found in MANIFESTS.items() for name in found["invalid"]]
CASES = [
    # Kernels with one model for each decision are compiled for the lowest effort alone. As plain
    # Python, each fourth file is read.
    pytest.param(
        version,
        name,
        marks=[pytest.mark.full] * ("fast" in name) + [pytest.mark.large] * (i % 4 > 0),
    )
    for i, (version, name) in enumerate(FILES)
]


@pytest.mark.parametrize(("version", "name"), CASES)
def test_golden_file_decodes_to_what_it_always_did(version, name):
    expected = MANIFESTS[version]["files"][name]
    assert {"exercises": expected["exercises"], **found(GOLDEN / version / name)} == expected


@pytest.mark.large
@pytest.mark.parametrize("reader", [library, reference], ids=["library", "reference"])
def test_each_invalid_file_is_rejected_as_the_manifest_says(reader):
    for version, name in INVALID:
        entry = MANIFESTS[version]["invalid"][name]
        if reader is reference and entry["found_by"] == "mesh":
            continue
        path = GOLDEN / version / "invalid" / name
        answer = reader.answer({"task": "check", "file": str(path)})
        assert answer.get("error") == entry["outcome"], f"{name}: {answer}"


def test_invalid_files_are_what_the_manifest_says():
    for version, name in INVALID:
        entry = found_invalid(GOLDEN / version / "invalid" / name)
        assert entry == MANIFESTS[version]["invalid"][name]


def test_clauses_of_invalid_files_exist():
    names = {"P": "format-predictive", "R": "format-rapid", "C": "format-cdf53"}
    for clause in {case.clause for case in invalid.CASES.values()}:
        place, _, number = clause.rpartition(" ")
        name = place or names.get(number[0], "FORMAT")
        text = (DOCS / f"{name}.md").read_text(encoding="utf-8")
        assert re.search(rf"^##+ {re.escape(number.strip('§'))}\.? ", text, re.M), clause


def test_the_runner_fails_a_reader_that_is_wrong_in_any_part():
    manifest = MANIFESTS["v2"]
    valid, entry = manifest["files"]["one-row.twz"], manifest["invalid"]["header-crc.twz"]
    right = {"describe": valid, "level": valid["level"][0], "check": {"error": "corrupt"}}
    right |= {"blocks": valid["level"][0], "mesh": valid["level"][0]}

    class Reader:
        def __init__(self, wrong):
            self.wrong = wrong

        def ask(self, task, file, level=0):
            found = valid["level"][level] if task in ("level", "blocks", "mesh") else right[task]
            return {} if task == self.wrong else found

    def failures(wrong):
        reader = Reader(wrong)
        rows = [
            *run_conformance.judge_valid(reader, library.PROFILE, "a", valid),
            *run_conformance.judge_invalid(reader, library.PROFILE, "b", entry),
        ]
        return [part for part, outcome, _ in rows if outcome == "failed"]

    assert failures(None) == []
    assert failures("describe") == ["metadata"]
    assert failures("level") == ["heights"]
    assert failures("blocks") == ["blocks"]
    assert failures("mesh") == ["meshes"]
    assert failures("check") == ["invalid"]


def test_the_packed_set_is_the_same_each_time_and_can_be_run(tmp_path):
    for name in ("one.zip", "two.zip"):
        make_conformance.main(tmp_path / name)
    data = (tmp_path / "one.zip").read_bytes()
    assert data == (tmp_path / "two.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.zip") as archive:
        archive.extractall(tmp_path)
    folder = tmp_path / make_conformance.NAME
    text = (DOCS / "FORMAT.md").read_text(encoding="utf-8")
    for name in re.findall(r"^\| `(\S+)` \| \d+ \| `\w{64}`", text, re.M):
        assert (folder / "annexes" / name).read_bytes() == read_annex(name)
    # A reader that knows nothing refuses all, which is outside, and is wrong where it takes a file.
    nothing = "; ".join([
        "import json, sys",
        "p = dict(name='none', methods=[], features=0, meshes=[], blocks=False, verifier=False)",
        "a = lambda q: p if 'profile' in q else {'error': 'unsupported'}",
        "[print(json.dumps(a(line)), flush=True) for line in sys.stdin]",
    ])  # fmt: skip
    command = [sys.executable, folder / "run_conformance.py", "--", sys.executable, "-c", nothing]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(rf"^heights +0 +{len(FILES)} +0$", done.stdout, re.M)


def test_golden_files_are_of_the_version_that_is_written():
    assert list(MANIFESTS) == [f"v{FORMAT_VERSION}"]


def test_manifests_name_all_golden_files():
    assert {(path.parent.name, path.name) for path in GOLDEN.glob("v*/*.twz")} == set(FILES)
    invalid_files = {(path.parts[-3], path.name) for path in GOLDEN.glob("v*/invalid/*.twz")}
    assert invalid_files == set(INVALID)


def test_golden_files_stay_small():
    sizes = [path.stat().st_size for path in GOLDEN.rglob("*.twz")]
    assert max(sizes, default=0) <= 20_000  # two bands of rapid
    for version in MANIFESTS:
        assert sum(path.stat().st_size for path in (GOLDEN / version).glob("*.twz")) <= 190_000
        assert sum(path.stat().st_size for path in GOLDEN.glob(f"{version}/invalid/*")) <= 90_000
