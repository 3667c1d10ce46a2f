"""Files with a one-sided bound: `base` off the middle by half a step, and a word that says so."""

from fractions import Fraction

import numpy as np
import pytest
from click.testing import CliRunner
from conformance.editor import Editor
from strategies import terrain_like
from twz import twz_bytes

import terrainwave as tw
from terrainwave.cli import main
from terrainwave.errors import InvalidHeightsError
from terrainwave.reference.units import decode


def one_sided(heights, side, max_error):
    """Return a file whose heights were moved by half a step, as a writer would do it."""
    editor = Editor(twz_bytes(heights, max_error=max_error / 2, mesh="none"))
    half = editor.fields["step"] // 2
    editor.set_json(bound=side)
    sign = {"above": 1, "below": -1}[side]
    editor.header = {"base": editor.fields["base"] + sign * half}
    editor.header |= {name: 2 * editor.fields[name] for name in ("max_error", "effective_bound")}
    return editor.bytes()


@pytest.mark.few(1)
@pytest.mark.parametrize("side", ["above", "below"])
@pytest.mark.parametrize(
    ("dtype", "divisor"),
    [("int16", 1), ("int32", 1), ("float32", 8), ("float64", 100), ("float32", 100)],
)
def test_heights_lie_on_the_side_that_the_word_says(side, dtype, divisor):
    heights = (terrain_like(70, 60, seed=1).astype(np.int64) * 7 / divisor).astype(dtype)
    max_error = 40 / divisor
    data = one_sided(heights, side, max_error)
    with tw.open(data) as terrain:
        assert terrain.header.step > 1
        assert terrain.info().bound == side
        found = terrain.read()
        spacing = terrain.quantizer.float_error
    np.testing.assert_array_equal(found, decode(data)[0])
    apart = found.astype(np.float64) - heights
    apart = apart if side == "above" else -apart
    assert apart.min() >= -spacing
    assert apart.max() <= max_error + spacing
    assert apart.max() > max_error / 2


def test_the_raw_heights_are_the_exact_quotients():
    """FORMAT.md §2.3: raw = (base + k) · quantum_num / quantum_den, rounded once."""
    heights = np.round(terrain_like(40, 50, seed=1) / 100.0, 2)
    plain = twz_bytes(heights, max_error=0.2, mesh="none")
    with tw.open(plain) as first, tw.open(one_sided(heights, "above", 0.4)) as second:
        quantum, half = first.header.quantum, first.header.step // 2
        numbers = [round(Fraction(value) / quantum) for value in first.read().ravel().tolist()]
        expected = [float((number + half) * quantum) for number in numbers]
        assert second.read().ravel().tolist() == expected


@pytest.mark.parametrize("word", ["sideways", 1, ["above"], None])
def test_another_word_means_both_sides(word):
    editor = Editor(twz_bytes(np.arange(12).reshape(3, 4).astype(np.int16), max_error=1))
    editor.set_json(bound=word)
    with tw.open(editor.bytes()) as terrain:
        assert terrain.info().bound == "both"
        assert terrain.header.coded_error == 1


def test_errors_of_meshes_count_both_halves():
    data = one_sided(terrain_like(40, 50, seed=1), "below", 8)
    with tw.open(data) as terrain:
        assert terrain.header.coded_error == terrain.header.step - 1


def test_info_says_it_in_words_and_a_patch_is_refused(tmp_path):
    heights = terrain_like(40, 50, seed=1)
    path = tmp_path / "a.twz"
    path.write_bytes(one_sided(heights, "above", 8))
    said = CliRunner().invoke(main, ["info", str(path)]).output
    assert "no height is below its original" in " ".join(said.split())
    with pytest.raises(InvalidHeightsError, match="heights above the originals only"):
        tw.patch(path, heights)
