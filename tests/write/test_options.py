"""`Options` are checked where they are made, and say what they stand for."""

import numpy as np
import pytest
from strategies import terrain_like, write_geotiff

from terrainwave import Cdf53, Cdf97, Predictive, Rqt, Store, Zerotree
from terrainwave.codec import method_options
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.names import MESH_KINDS, MESHES, METHODS
from terrainwave.write.compress import compress
from terrainwave.write.compress_options import Options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_error": -1}, "found max_error -1, expected a finite number >= 0"),
        ({"method": "zip"}, "found method 'zip', expected one of auto, rapid, predictive"),
        ({"block": 100}, "found block 100, expected one of 32, 64, 128, 256, 512, 1024"),
        ({"method": Cdf97}, "expected a name, such as 'rapid', or options of a method, such as tw"),
        ({"mesh": Zerotree}, "expected a name, such as 'halves', or options of a kind of meshes"),
        ({"mesh": Zerotree(labels="coded"), "method": "cdf97"}, "found labels=coded for a file"),
        (
            {"mesh": Rqt(select="coefficient")},
            "found select=coefficient for a file of method rapid",
        ),
        ({"threads": 0}, "found threads 0, expected a whole number >= 1"),
        ({"max_error": 1, "method": Cdf53(rate=1)}, "found max_error and rate, expected one of"),
        ({"strict": True, "method": Cdf53(psnr=1)}, "found strict and psnr, expected max_error"),
    ],
)
def test_what_cannot_be_is_refused_where_options_are_made(options, message):
    with pytest.raises(InvalidHeightsError, match=message):
        Options(**options)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (Cdf97, {"border_rings": 2}, "found border_rings 2, expected 1 or 3"),
        (Store, {"border_rings": True}, "found border_rings True, expected 1 or 3"),
        (Predictive, {"border_rings": "3"}, "found border_rings the text '3', expected 1 or 3"),
        (Cdf97, {"faithful": 1}, "found faithful 1, expected True or False"),
        (Cdf53, {"rate": 0}, "found rate 0, expected a finite number > 0"),
        (Cdf53, {"psnr": float("nan")}, "found psnr nan, expected a finite number > 0"),
        (Cdf53, {"rate": 1, "psnr": 40}, "found rate=1 and psnr=40, expected one of them"),
        (Zerotree, {"labels": "none"}, "found labels 'none', expected one of plain, layer, coded"),
        (Zerotree, {"labels": 1}, "found labels the number 1, expected"),
        (Rqt, {"select": None}, "found select None, expected error or coefficient"),
    ],
)
def test_own_options_that_cannot_be_are_refused_where_they_are_made(kind, options, message):
    with pytest.raises(InvalidArgumentError, match=f"^{message}"):
        kind(**options)


@pytest.mark.parametrize("mesh", [kind for kind in MESHES if "-" in kind])
def test_names_that_files_have_for_meshes_are_none_that_can_be_asked_for(mesh):
    expected = "expected one of auto, halves, zerotree, rqt, none"
    with pytest.raises(InvalidArgumentError, match=f"^found mesh '{mesh}', {expected}"):
        Options(mesh=mesh)


def test_no_name_is_an_option_of_a_method_and_of_meshes():
    """-o sets both."""
    of_methods = {name for method in METHODS for name in method_options.options_of(method).names()}
    of_meshes = {name for kind in (Zerotree, Rqt) for name in kind.names()}
    assert not of_methods & of_meshes
    assert {kind.name for kind in (Zerotree, Rqt)} < {*MESH_KINDS}


def test_options_of_another_method_are_those_that_both_have():
    options = Options(method=Cdf97(border_rings=3, faithful=True), mesh=Zerotree())
    other = options.with_method(METHODS["store"], "zerotree-plain")
    assert (other.method, other.mesh_kind) == (Store(border_rings=3), "zerotree-plain")


@pytest.mark.parametrize("name", ["stable", "strict", "keep_origin", "verify"])
@pytest.mark.parametrize("value", ["no", "False", 0, 1, None])
def test_what_is_neither_true_nor_false_is_refused(name, value):
    with pytest.raises(InvalidArgumentError, match=f"^found {name} .*, expected True or False$"):
        Options(**{"max_error": 1, name: value})


@pytest.mark.parametrize("name", ["georeference", "overwrite"])
def test_texts_are_no_flags_of_compress(tmp_path, name):
    target = tmp_path / "a.twz"
    target.write_bytes(b"somebody's")
    with pytest.raises(InvalidArgumentError, match=f"^found {name} 'no', expected True or False$"):
        compress(terrain_like(9, 9), target, **{"overwrite": True, name: "no"})
    assert target.read_bytes() == b"somebody's"


def test_faithful_files_have_no_efforts():
    (note,) = Options(method=Cdf97(faithful=True), effort="best").notes
    assert note.startswith("effort best changes nothing: faithful")
    assert Options(method=Cdf97(faithful=True)).notes == []


@pytest.mark.parametrize(
    ("own", "other"),
    [
        (Cdf97(), "store"),
        (Cdf97(faithful=True), None),
        (Cdf53(), "store"),
        (Cdf53(rate=1), None),
        (Cdf53(psnr=40), None),
        (Store(), None),
    ],
)
def test_what_codes_heights_that_do_not_compress_is_decided_with_the_method(own, other):
    found = Options(method=own).choice.other
    assert other == (found and found.name)


def test_a_faithful_file_stays_one_where_heights_do_not_compress(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (33, 33), dtype="uint8")
    target = tmp_path / "noise.twz"
    result = compress(noise, target, max_error=0, method=Cdf97(faithful=True), mesh="none")
    assert result.n_bytes > 1.1 * noise.nbytes
    assert result.method == "cdf97"


def test_a_size_of_tasks_is_refused_where_there_are_none(tmp_path):
    write_geotiff(tmp_path / "dem.tif", terrain_like(33, 33))
    with pytest.raises(InvalidHeightsError, match="found task_samples 5 without a client"):
        compress(tmp_path / "dem.tif", tmp_path / "dem.twz", task_samples=5)
    assert not (tmp_path / "dem.twz").exists()
