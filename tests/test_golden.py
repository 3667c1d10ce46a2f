"""Do files of every released format version still decode to the same heights and meshes?"""

import json

import pytest
from golden_files import GOLDEN, digests

from terrainwave.container.header import FORMAT_VERSION

MANIFESTS = {
    path.parent.name: json.loads(path.read_text(encoding="utf-8"))
    for path in sorted(GOLDEN.glob("v*/manifest.json"))
}
FILES = [(version, name) for version, files in MANIFESTS.items() for name in files]
CASES = [
    # Kernels with one model for each decision are compiled for the lowest effort alone.
    pytest.param(version, name, marks=pytest.mark.full if "fast" in name else [])
    for version, name in FILES
]


@pytest.mark.parametrize(("version", "name"), CASES)
def test_golden_file_decodes_to_what_it_always_did(version, name):
    expected = MANIFESTS[version][name]
    assert digests(GOLDEN / version / name) == {
        key: expected[key] for key in ("file", "heights", "mask", "mesh")
    }


def test_every_version_has_golden_files():
    assert list(MANIFESTS) == [f"v{version}" for version in range(1, FORMAT_VERSION + 1)]


def test_manifests_name_all_golden_files():
    found = {(path.parent.name, path.name) for path in GOLDEN.rglob("*.twz")}
    assert found == set(FILES)


def test_golden_files_stay_small():
    sizes = [path.stat().st_size for path in GOLDEN.rglob("*.twz")]
    assert max(sizes, default=0) <= 10_000
    for version in MANIFESTS:
        assert sum(path.stat().st_size for path in (GOLDEN / version).glob("*.twz")) <= 120_000
