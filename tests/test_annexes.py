"""The annexes of the format are what its documents describe, and what the tools write."""

import re
import shutil
import sys
from hashlib import sha256
from pathlib import Path

import pytest

from terrainwave import annexes
from terrainwave.annexes import read_annex, read_tables
from terrainwave.codec import masks
from terrainwave.codec.cdf97 import trained as cdf97
from terrainwave.codec.predictive import trained as predictive
from terrainwave.codec.rapid import file_tables as rapid
from terrainwave.errors import StorageError

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
FOLDER = Path(annexes.__file__).parent
TYPES = {"int16": "<i2", "uint16": "<u2", "uint8": "|u1", "int32": "<i4"}
BINARY = [
    (predictive, "format-predictive.md", "P.9"),
    (masks, "FORMAT.md", "5.2"),
    (cdf97, "FORMAT.md", "7.8"),
    (rapid, "format-rapid.md", "R.11"),
]

sys.path.append(str(ROOT / "tools"))


def section(document, number):
    text = (DOCS / document).read_text(encoding="utf-8")
    return re.search(rf"^#+ {re.escape(number)}\.? .*?(?=^#|\Z)", text, re.M | re.S)[0]


def test_the_files_are_those_that_the_format_lists():
    rows = re.findall(r"^\| `(\S+)` \| (\d+) \| `(\w{64})`", section("FORMAT.md", "15"), re.M)
    kept = [path for path in FOLDER.iterdir() if path.is_file() and path.suffix != ".py"]
    assert sorted(rows) == sorted(
        (path.name, str(path.stat().st_size), sha256(path.read_bytes()).hexdigest())
        for path in kept
    )


@pytest.mark.parametrize(("annex", "document", "number"), BINARY)
def test_the_layout_is_that_of_the_document(annex, document, number):
    row = r"^\| (\d+) \| (u?int\d+) \| (\d+(?: × \d+)*) \| (\w+) \|"
    described = [
        (name, int(offset), TYPES[kind], tuple(map(int, shape.split(" × "))))
        for offset, kind, shape, name in re.findall(row, section(document, number), re.M)
    ]
    assert described == [
        (name, offset, kind.base.str, kind.shape)
        for name, (kind, offset) in annex.LAYOUT.fields.items()
    ]


def test_the_tools_that_train_write_the_files():
    """What they train, here the tables in use, lies where readers look for it."""
    pytest.importorskip("scipy")
    import train_cdf97
    import train_masks
    import train_stencils

    found = read_tables(cdf97.ANNEX, cdf97.LAYOUT)
    starts = [found[name] for name in ("residuals", "trees", "border")]
    assert train_cdf97.annex(starts) == read_annex(cdf97.ANNEX)
    starts = read_tables(predictive.ANNEX, predictive.LAYOUT)["starts"]
    made = train_stencils.annex(predictive.STENCILS, predictive.E_WEIGHTS, starts)
    assert made == read_annex(predictive.ANNEX)
    assert train_masks.annex(*masks.frequencies()) == read_annex(masks.ANNEX)
    assert rapid.packed(rapid.annex()) == read_annex(rapid.ANNEX)


def test_numbers_that_do_not_fit_are_not_written():
    pytest.importorskip("scipy")
    import train_stencils

    stencils = {plane: sets.copy() for plane, sets in predictive.STENCILS.items()}
    stencils[3][7, 0] = 40_000
    starts = read_tables(predictive.ANNEX, predictive.LAYOUT)["starts"]
    with pytest.raises(OverflowError):
        train_stencils.annex(stencils, predictive.E_WEIGHTS, starts)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return the folder of a copy of the annexes, which is where they are read from."""
    shutil.copytree(FOLDER, tmp_path / "annexes")
    monkeypatch.setattr(annexes, "__file__", str(tmp_path / "annexes" / "__init__.py"))
    read_annex.cache_clear()
    yield tmp_path / "annexes"
    read_annex.cache_clear()


def test_a_missing_annex_is_named(folder):
    (folder / "cdf97.bin").unlink()
    with pytest.raises(StorageError, match=r"cdf97\.bin: No such file .*: install it again, with"):
        read_tables("cdf97.bin", cdf97.LAYOUT)


@pytest.mark.parametrize("change", [-1, 1])
def test_an_annex_of_another_size_is_named(folder, change):
    data = (folder / "cdf97.bin").read_bytes()
    (folder / "cdf97.bin").write_bytes((data + b"x")[: len(data) + change])
    with pytest.raises(StorageError, match=rf"{len(data) + change} bytes, expected {len(data)}: "):
        read_tables("cdf97.bin", cdf97.LAYOUT)


def test_an_annex_is_read_once(folder):
    first = read_annex("dictionary.txt")
    (folder / "dictionary.txt").unlink()
    assert read_annex("dictionary.txt") is first
