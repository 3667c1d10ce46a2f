"""The targets of the fuzzer (fuzz/) on their corpus, without the fuzzer."""

from pathlib import Path

import pytest

import terrainwave
from fuzz import checksums
from fuzz.planted import PLANTED
from fuzz.targets import TARGETS, call, seeds

pytestmark = [pytest.mark.large, pytest.mark.filterwarnings("ignore")]
# No kernels run in these; the others compile theirs, in `make test-all`.
QUICK = ["header", "metadata", "pages", "planner", "remainders", "rounds"]


@pytest.fixture
def ignored():
    with checksums.ignored():
        yield


def test_each_target_has_a_corpus():
    assert all(seeds(name) for name in TARGETS)


@pytest.mark.parametrize("planted", PLANTED, ids=lambda planted: planted.path)
def test_checks_that_are_taken_out_to_try_the_fuzzer_are_there_once(planted):
    text = (Path(terrainwave.__file__).parent / planted.path).read_text(encoding="utf-8")
    assert text.count(planted.before) == 1


@pytest.mark.usefixtures("ignored")
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[] if name in QUICK else pytest.mark.full) for name in TARGETS],
)
def test_inputs_are_accepted_or_refused_by_our_own_error(name):
    inputs = [path.read_bytes() for path in seeds(name)]
    accepted = [call(name, data) for data in inputs]
    assert any(accepted)
    for data in inputs[:5]:
        for cut in range(1, min(len(data), 200), 23):
            call(name, data[:cut])


def test_changed_checksums_hide_nothing_from_the_fuzzer():
    changed = bytearray(seeds("header")[0].read_bytes())
    changed[-1] ^= 1
    assert not call("header", bytes(changed))
    with checksums.ignored():
        assert call("header", bytes(changed))
