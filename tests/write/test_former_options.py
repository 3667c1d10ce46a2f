"""The ways of 1.0 to give options of methods and meshes: they warn, and give the same bytes."""

import re
import warnings

import numpy as np
import pytest
from strategies import terrain_like

import terrainwave as tw
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import MESHES, METHODS

HEIGHTS = terrain_like(90, 100)


def made(folder, **options):
    folder.mkdir(exist_ok=True)
    result = tw.compress(
        HEIGHTS, folder / "a.twz", keep_origin=True, block=32, overwrite=True, **options
    )
    return (folder / "a.twz").read_bytes(), result.notes


@pytest.mark.parametrize(
    ("former", "new", "call"),
    [
        ({"border_rings": 3}, {"method": tw.Rapid(border_rings=3)}, "tw.Rapid(border_rings=3)"),
        (
            {"border_rings": 3, "effort": "fast"},
            {"method": tw.Rapid(border_rings=3)},
            "tw.Rapid(border_rings=3)",
        ),
        (
            {"border_rings": 3, "effort": "best"},
            {"method": tw.Predictive(border_rings=3), "effort": "best"},
            "tw.Predictive(border_rings=3)",
        ),
        (
            {"border_rings": 3, "method": "rapid", "effort": "fast"},
            {"method": tw.Rapid(border_rings=3), "effort": "fast"},
            "tw.Rapid(border_rings=3)",
        ),
        (
            {"border_rings": np.int64(3), "method": "store"},
            {"method": tw.Store(border_rings=3)},
            "tw.Store(border_rings=3)",
        ),
        (
            {"method": "cdf97", "faithful": True, "border_rings": 3, "mesh": "zerotree"},
            {"method": tw.Cdf97(faithful=True, border_rings=3), "mesh": "zerotree"},
            "tw.Cdf97(border_rings=3, faithful=True)",
        ),
        ({"method": "cdf97", "faithful": False}, {"method": "cdf97"}, "leave out"),
        (
            {"method": "cdf53", "rate": 1.5, "max_error": None},
            {"method": tw.Cdf53(rate=1.5), "max_error": None},
            "tw.Cdf53(rate=1.5)",
        ),
        (
            {"method": "cdf53", "psnr": 40, "max_error": None},
            {"method": tw.Cdf53(psnr=40), "max_error": None},
            "tw.Cdf53(psnr=40.0)",
        ),
        (
            {"mesh": "zerotree-layer"},
            {"mesh": tw.Zerotree(labels="layer")},
            "mesh=tw.Zerotree(labels='layer')",
        ),
        (
            {"mesh": "zerotree-plain", "method": "cdf97"},
            {"mesh": tw.Zerotree(labels="plain"), "method": "cdf97"},
            "mesh=tw.Zerotree(labels='plain')",
        ),
        (
            {"mesh": "rqt-coefficient", "method": "cdf53"},
            {"mesh": tw.Rqt(select="coefficient"), "method": "cdf53"},
            "mesh=tw.Rqt(select='coefficient')",
        ),
    ],
)
def test_the_former_way_gives_the_same_bytes_and_names_the_new_way(tmp_path, former, new, call):
    with pytest.warns(DeprecationWarning, match=f"2.0; .*{re.escape(call)}") as warned:
        before = made(tmp_path / "former", **{"max_error": 1} | former)
    assert {warning.filename for warning in warned} == {__file__}
    assert before == made(tmp_path / "new", **{"max_error": 1} | new)


def test_coded_labels_are_those_of_a_faithful_file(tmp_path):
    options = {"max_error": 1, "method": tw.Cdf97(faithful=True)}
    with pytest.warns(DeprecationWarning, match=re.escape("tw.Zerotree(labels='coded')")):
        former = made(tmp_path, mesh="zerotree-coded", **options)
    assert former == made(tmp_path, mesh=tw.Zerotree(labels="coded"), **options)
    assert former == made(tmp_path, mesh="zerotree", **options)


def test_stored_meshes_and_bytes_take_former_names_of_meshes(tmp_path):
    tw.compress(HEIGHTS, tmp_path / "a.twz", max_error=1, block=32)
    for name, mesh in {"former": "zerotree-layer", "new": tw.Zerotree(labels="layer")}.items():
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            tw.store_meshes(tmp_path / "a.twz", tmp_path / f"{name}.twz", mesh=mesh)
            data = tw.compress_to_bytes(HEIGHTS, max_error=1, block=32, mesh=mesh)
        assert [found.category for found in warned] == [DeprecationWarning] * 2 * (name == "former")
        (tmp_path / f"{name}.bytes").write_bytes(data)
    for ending in ("twz", "bytes"):
        found = [(tmp_path / f"{name}.{ending}").read_bytes() for name in ("former", "new")]
        assert found[0] == found[1]


def test_a_name_for_each_stored_kind_is_that_of_a_kind_or_a_former_one():
    from terrainwave.tri.mesh_options import of_former_name, stored_mesh

    for mesh in MESHES:
        asked = of_former_name(mesh) or mesh
        is_coded = mesh.endswith("coded")
        method = METHODS["cdf53" if mesh.endswith("coefficient") else "cdf97"]
        assert stored_mesh(asked, method, is_faithful=is_coded) == mesh


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"faithful": True}, "found faithful and method auto, expected method cdf97"),
        ({"faithful": True, "method": "store"}, "found faithful and method store, expected"),
        ({"rate": 1}, "found rate and method auto, expected method cdf53"),
        (
            {"rate": 1, "psnr": 2, "method": "cdf53"},
            "found rate=1 and psnr=2, expected one of them",
        ),
        ({"border_rings": 3, "method": "cdf53"}, "expected method rapid, predictive, cdf97 or st"),
        ({"border_rings": 2}, "found border_rings 2, expected 1 or 3"),
        ({"faithful": 0, "method": "cdf97"}, "found faithful 0, expected True or False"),
        ({"mesh": "zerotree-x"}, "found mesh 'zerotree-x', expected one of auto, halves, zerotree"),
    ],
)
def test_former_options_that_cannot_be_are_refused(tmp_path, options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        tw.compress(HEIGHTS, tmp_path / "a.twz", **options)


def test_a_former_option_is_none_of_functions_that_never_had_it():
    with pytest.raises(TypeError, match="rate"):
        tw.compress_to_bytes(HEIGHTS, rate=1)
