"""FORMAT.md and the code say the same: offsets, limits, section numbers."""

import re
import zlib
from pathlib import Path

import pytest

from terrainwave.container import header as header_module
from terrainwave.container.header import DTYPE_CODES, HEADER_SIZE, MAGIC
from terrainwave.container.page import empty_page, pack_columns, page_layout
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.names import METHODS

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "FORMAT.md").read_text(encoding="utf-8")
SIZES = {"uint8": 1, "uint16": 2, "uint32": 4, "int32": 4, "uint64": 8, "int64": 8, "float64": 8}
LETTERS = {"B": "uint8", "H": "uint16", "I": "uint32", "i": "int32"}
LETTERS |= {"Q": "uint64", "q": "int64", "d": "float64", "8s": "bytes", "2s": "bytes"}


def section(number):
    """Return the text of a section, to the next heading of any depth."""
    return re.search(rf"^#+ {re.escape(number)}\.? .*?(?=^#)", DOCUMENT, re.M | re.S)[0]


def rows(text, n_columns):
    """Return the cells of all table rows with this many columns, without heads and rules."""
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    return [row for row in found if len(row) == n_columns and not row[0].startswith("-")][1:]


HEADER_ROWS = rows(section("4.1"), 5)


def test_the_header_table_has_no_gaps_and_128_bytes():
    end = 0
    for offset, size, kind, _, _ in HEADER_ROWS:
        assert int(offset) == end
        assert SIZES.get(kind, int(size)) == int(size)
        end += int(size)
    assert end == HEADER_SIZE == 128


def test_the_header_table_has_the_types_that_the_code_packs():
    letters = [*header_module._LAYOUT.format.strip("<").split(), "I"]
    assert [LETTERS[letter] for letter in letters] == [row[2] for row in HEADER_ROWS]


def test_magic_methods_and_data_types_are_those_of_the_table():
    cells = {row[3]: row[4] for row in HEADER_ROWS}
    assert cells["magic"].startswith(MAGIC.hex(" ").upper())
    listed = re.findall(r"(\d+) (\w+)", cells["method"])
    assert {int(number): name for number, name in listed} == {
        method.number: method.name for method in METHODS.values()
    }
    for dtype, code in DTYPE_CODES.items():
        assert f"{code} {dtype}" in cells["dtype"]


@pytest.mark.parametrize("side", [1, 2000, 16_000])
def test_the_columns_of_a_page_have_the_size_of_format_3_3(side):
    layout = page_layout(Grid(side, side, 32), None)
    n_keys, n_blocks, n_children = map(len, layout)
    rows_of = {"K": n_keys, "B": n_blocks, "S": n_children}
    columns = [row for row in rows(section("3.3"), 4) if row[1] in rows_of]
    assert len(columns) == 11
    expected = sum(rows_of[n_rows] * SIZES[kind] for _, n_rows, kind, _ in columns)
    assert len(zlib.decompress(pack_columns(empty_page(layout)))) == expected
    assert expected <= 5_877


def test_the_largest_page_has_the_columns_of_format_10():
    layout = page_layout(Grid(4097, 4097, 32), Block(3, 0, 0))
    assert (len(layout.keys), len(layout.blocks), len(layout.children)) == (85, 340, 0)
    layout = page_layout(Grid(2**16 + 1, 2**16 + 1, 32), Block(3, 0, 0))
    assert (len(layout.keys), len(layout.blocks), len(layout.children)) == (85, 340, 256)
    limits = {row[0]: row[1] for row in rows(section("10"), 3)}
    assert limits["keys of a page"] == "22 top, 85 others"
    assert limits["blocks of a page"] == "85 top, 340 others"
    assert limits["child segments of a page"] == "64 top, 256 others"
    n_bytes = len(zlib.decompress(pack_columns(empty_page(layout))))
    assert limits["columns of a page, inflated"] == f"{n_bytes} bytes"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("MAX_SIDE", "| n_rows, n_cols | 2^31 |"),
        ("MAX_SAMPLES", "| n_rows · n_cols | 2^50 |"),
        ("MAX_METADATA", "| metadata, deflated and inflated | 2^20 bytes |"),
        ("MAX_PARAMETERS", "| parameters | 2^16 bytes |"),
        ("MAX_PAGE", "| page | 2^15 bytes |"),
        ("MAX_Z", "| quanta | −2^30"),
    ],
)
def test_limits_of_the_code_are_those_of_format_10(name, text):
    assert text in section("10")
    assert getattr(header_module, name) == 1 << int(re.search(r"2\^(\d+)", text)[1])


def test_every_section_that_the_code_cites_exists():
    headings = set(re.findall(r"^#+ (\d+(?:\.\d+)?)", DOCUMENT, re.M))
    for path in (ROOT / "src" / "terrainwave").rglob("*.py"):
        for cited in re.findall(r"FORMAT\.md §(\d+(?:\.\d+)?)", path.read_text(encoding="utf-8")):
            assert cited in headings, f"{path.name} cites §{cited}"
