"""The worked example of docs/FORMAT.md §9: its bytes mean what it says, and are what we write."""

import json
import re
import zlib
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from reference_decoder import predictive
from twz import twz_bytes

import terrainwave
from terrainwave.codec.cdf97 import refiner as cdf97
from terrainwave.reference import cdf97 as reference_cdf97
from terrainwave.reference import digests, rapid
from terrainwave.reference.basics import inflate
from terrainwave.reference.files import DICTIONARY, NAMES, block_codes, read_file
from terrainwave.reference.payloads import Bits, decode_root
from terrainwave.reference.units import decode, decode_units

DOCS = Path(__file__).parents[1] / "docs"
DOCUMENT = (DOCS / "FORMAT.md").read_text(encoding="utf-8")
EXAMPLE_OF_PREDICTIVE = (
    (DOCS / "format-predictive.md").read_text(encoding="utf-8").partition("\n## P.11 ")[2]
)
EXAMPLE_OF_RAPID = (DOCS / "format-rapid.md").read_text(encoding="utf-8").partition("\n## R.13 ")[2]
ROOT_KEY = (-1, 0, 0)


def section(number):
    return re.search(rf"^### {re.escape(number)} .*?(?=^##)", DOCUMENT, re.M | re.S)[0]


def rows(text):
    """Return (bytes, meaning) of the rows of a table, checking the offsets."""
    found = []
    offset = 0
    for start, data, meaning in re.findall(
        r"^\| (\d+) \| ([0-9a-f]{2}(?: [0-9a-f]{2})*) \| (.+) \|$", text, re.M
    ):
        assert int(start) == offset
        found.append((bytes.fromhex(data), meaning))
        offset += len(found[-1][0])
    return found


def hexdump(text):
    return b"".join(data for data, _ in rows(text))


def grid(name, document=DOCUMENT):
    """Return the numbers of a fenced block; 0 where it has a dot."""
    text = re.search(rf"^```{name}\n(.*?)^```", document, re.M | re.S)[1]
    return np.array(
        [[int(cell.replace("·", "0")) for cell in line.split()] for line in text.splitlines()]
    )


FILE = hexdump(section("9.2"))
HEIGHTS, DECODED = grid("heights"), grid("decoded")


def encoded(method):
    """Return the raster's file; of `cdf97` with coefficients, though raw heights are smaller."""
    with (
        patch.object(cdf97, "_FINEST_STEPS", ((128,),) * 3),
        patch.object(cdf97._Encoder, "attempt_raw"),
    ):
        return encoded_freely(method)


def encoded_freely(method):
    return twz_bytes(HEIGHTS.astype("int16"), max_error=1, nodata=-1, method=method, mesh="none")


def page_of(data):
    """Return first_child and the inflated columns of the top page."""
    header = read_file(data).header
    start = 128 + header.metadata_length
    page = data[start : start + header.top_page_length]
    return page[4:12], zlib.decompress(page[12:])


def test_library_and_reference_decode_the_file_to_the_stated_heights():
    with terrainwave.open(FILE) as terrain:
        assert list(terrain.check()) == []
        heights, valid = terrain.read_with_mask()
    assert heights.dtype == np.int16
    for found, mask in ((heights, valid), decode(FILE)):
        np.testing.assert_array_equal(found, DECODED)
        np.testing.assert_array_equal(mask, grid("mask"))
    assert abs(DECODED - HEIGHTS).max() == 1


def test_encoding_the_raster_gives_the_content_of_the_example():
    expected, found = read_file(FILE), read_file(encoded("cdf97"))
    # Deflated bytes, and what depends on them, differ between implementations of zlib.
    deflated = {"file_size", "metadata_length", "metadata_crc", "top_page_length", "header_crc"}
    for name in set(NAMES) - deflated:
        assert getattr(found.header, name) == getattr(expected.header, name), name
    assert found.metadata | {"software": ""} == expected.metadata | {"software": ""}
    assert page_of(encoded("cdf97")) == page_of(FILE)
    assert found.payloads == expected.payloads


def test_rows_of_the_file_are_the_fields_of_the_header():
    header = read_file(FILE).header
    n_fields = 0
    for (_, meaning), name in zip(rows(section("9.2")), NAMES, strict=False):
        if meaning.split()[0] == name and name not in ("magic", "padding", "tail", "reserved"):
            number = re.search(r"(?:0x[0-9A-F]+|−?[\d.]+)$|(?<= )−?\d+(?=:)", meaning)
            value = (
                float(number[0].replace("−", "-")) if "x" not in number[0] else int(number[0], 16)
            )
            assert value == getattr(header, name), meaning
            n_fields += 1
    assert n_fields == 28


def test_deflated_sections_inflate_to_the_stated_content():
    header = read_file(FILE).header
    section_bytes = FILE[128 : 128 + header.metadata_length]
    text = inflate(section_bytes, 2**20, DICTIONARY).decode()
    assert text == re.search(r"^```json\n(.*?)\n```", section("9.3"), re.M | re.S)[1]
    assert json.loads(text).keys() == {"mask_kind", "nodata", "software"}
    assert page_of(FILE) == (bytes(8), hexdump(section("9.4")))


def test_bits_of_the_mask_have_the_stated_models_and_states():
    found = []

    class Recorder(Bits):
        def read(self, model):
            bit = super().read(model)
            found.append((model, bit, self.states[0], self.at))
            return bit

    section_bytes = next(
        data for data, meaning in rows(section("9.2")) if meaning.startswith("mask section")
    )
    bits = Recorder(section_bytes)
    text = section("9.5")
    stated = re.search(r"a = (\d+) and b = (\d+) and has one state, (\d+)", text)
    assert stated.groups() == (
        str(section_bytes[0] % 16), str(section_bytes[0] // 16), str(bits.states[0])
    )  # fmt: skip
    assert decode_root(bits, 5, 5) == grid("mask").tolist()
    bits.end()
    table = re.findall(r"^\| (\d+) \| .* \| (\d+) \| (\d) \| (\d+) \| (\d) \|$", text, re.M)
    assert len(table) == 6
    for number, *cells in table:
        assert found[int(number)] == tuple(map(int, cells))
    assert f"{len(found)} bits" in text


def test_coefficients_details_and_residuals_are_the_stated_ones():
    steps = []

    def recording(name):
        function = getattr(reference_cdf97, name)

        def wrapper(*args):
            steps.append((args, function(*args)))
            return steps[-1][1]

        return patch.object(reference_cdf97, name, wrapper)

    with recording("decode_coefficients"), recording("inverse_transform"):
        ((_, quanta, valid, _),) = decode_units(read_file(FILE), 0)
    (_, (ll, coefficients, _)), ((low, _, _), field) = steps
    rows = re.findall(
        r"^\| (\d) \| \d × \d \| (.*) \| (.*) \| (.*) \| (.*) \|$", section("9.6"), re.M
    )
    assert [row[0] for row in rows] == ["2", "1", "0"]
    for t, stated_ll, *bands in rows:
        if stated_ll:
            assert stated_ll.startswith(f"{ll} ".replace("-", "−"))
        for band, cell in zip(("HL", "LH", "HH"), bands, strict=True):
            stated = [
                int(n)
                for n in re.sub(r"\(\d+\)", "", cell).replace("−", "-").split(",")
                if n.strip()
            ]
            found = np.array(coefficients[int(t)][band]).ravel().tolist()
            assert [q for q in found if q] == [q for q in stated if q]
    assert f"LL stands for {low}".replace("-", "−") in section("9.6")
    detail = (np.array(field) + 32) >> 6
    np.testing.assert_array_equal(detail, grid("detail"))
    unclipped = (grid("prediction") + 3 * grid("residuals"))[np.array(valid) == 1]
    quanta = np.array(quanta)
    np.testing.assert_array_equal(np.clip(unclipped, -36, 36), quanta[np.array(valid) == 1])
    np.testing.assert_array_equal(np.where(valid, quanta + 320, -1), DECODED)


@pytest.mark.parametrize("decoder", ["library", "reference"])
def test_the_payload_of_method_store_is_the_stated_one(decoder):
    data = encoded("store")
    assert read_file(data).payloads == {ROOT_KEY: hexdump(section("9.7"))}
    with terrainwave.open(data) as terrain:
        found = terrain.read() if decoder == "library" else decode(data)[0]
    np.testing.assert_array_equal(found, grid("store"))


def test_the_payload_of_method_predictive_is_the_stated_one():
    data = encoded("predictive")
    assert read_file(data).payloads == {ROOT_KEY: hexdump(EXAMPLE_OF_PREDICTIVE)}
    with terrainwave.open(data) as terrain:
        found = terrain.read()
    np.testing.assert_array_equal(found, grid("decoded", EXAMPLE_OF_PREDICTIVE))
    np.testing.assert_array_equal(found, decode(data)[0])


def test_predictions_and_details_of_predictive_are_the_stated_ones():
    coded = []

    class Recorder(predictive.PlaneDecoder):
        def expected(self, i, j, *rest):
            coded.append([self.lattice.stride, self.plane, i, j])
            return super().expected(i, j, *rest)

        def decode_detail(self, e, core, near, p):
            q = super().decode_detail(e, core, near, p)
            height = np.clip(((p + 32) >> 6) + 3 * q, -36, 36)
            coded[-1] += [p, e, q, height]
            return q

    with patch.object(predictive, "PlaneDecoder", Recorder):
        decode(encoded("predictive"))
    stated = re.findall(r"^\| (\d) \| ([HL]+) \| (.*) \|$", EXAMPLE_OF_PREDICTIVE, re.M)
    assert [[int(stride), plane] for stride, plane, _ in stated] == [row[:2] for row in coded]
    for (_, _, cells), (_, _, *numbers) in zip(stated, coded, strict=True):
        cells = cells.replace("−", "-").replace(" |", ",").split(",")
        assert [int(cell) for cell in cells] == numbers


@pytest.mark.parametrize("decoder", ["library", "reference"])
def test_the_payload_of_method_rapid_is_the_stated_one(decoder):
    data = encoded("rapid")
    assert read_file(data).payloads == {ROOT_KEY: hexdump(EXAMPLE_OF_RAPID)}
    stated = re.search(r"^```parameters\n(.*?)\n```", EXAMPLE_OF_RAPID, re.M)[1]
    assert read_file(data).parameters == bytes.fromhex(stated)
    with terrainwave.open(data) as terrain:
        found = terrain.read() if decoder == "library" else decode(data)[0]
    np.testing.assert_array_equal(found, grid("decoded", EXAMPLE_OF_RAPID))


def recorded_of_rapid():
    """Return the lists and the samples of the example, each as the cells of a row."""
    lists, samples = [], []

    class Recorder(rapid.Lattice):
        def read_batch(self, band, plane, rows, first):
            self.list = [str(self.stride), plane]
            self.class_of = {id(t): f"pair of class {k}" for k, t in enumerate(self.tables.pairs)}
            names = [f"sample of class {k}" for k in range(60)] + ["sample of an escaped pair"]
            self.class_of |= dict(zip(map(id, self.tables.samples), names, strict=True))
            with patch.object(rapid.Band, "symbols", self.symbols_of(band)):
                super().read_batch(band, plane, rows, first)

        def symbols_of(self, band):
            def symbols(_, entries):
                found = read_symbols(band, entries)
                if entries:
                    cells = ["none" if entry is None else f"{self.class_of[id(entry)]}: {y}"
                             for entry, y in zip(entries, found, strict=True)]  # fmt: skip
                    lists.append([*self.list, ", ".join(cells), str(band.states[0])])
                return found

            return symbols

        def make_heights(self, parent):
            super().make_heights(parent)
            for plane, (n_rows, n_cols) in self.sizes.items():
                for i, j in np.ndindex(n_rows, n_cols):
                    p, is_turned = self.predict(plane, i, j)
                    numbers = self.expected(plane, i, j, 0), p, self.details.get((plane, i, j), 0)
                    row, col = self.place(plane, i, j)
                    cells = [*numbers, "yes" if is_turned else "no", self.heights[row][col]]
                    samples.append([self.stride, plane, f"{i}, {j}", f"{row}, {col}", *cells])

    read_symbols = rapid.Band.symbols
    with patch.object(rapid, "Lattice", Recorder):
        decode(encoded("rapid"))
    return lists, [[str(cell).replace("-", "−") for cell in row] for row in samples]


def test_symbols_predictions_and_details_of_rapid_are_the_stated_ones():
    lists, samples = recorded_of_rapid()
    stated = re.findall(r"^\| (\d \| [HL]+ \| .*) \|$", EXAMPLE_OF_RAPID, re.M)
    assert [row.split(" | ") for row in stated] == lists + samples


def whole_file():
    """Return the second example of §9.7: its file, heights and the rows of its page's columns."""
    text = re.search(r"^#### A whole file .*?(?=^## )", DOCUMENT, re.M | re.S)[0]
    file_text, _, page_text = text.partition("| 192 |")
    last, _, page_text = page_text.partition("\n")
    data = hexdump(f"{file_text}| 192 |{last}\n")
    return data, grid("two-levels"), rows(re.sub("^ +", "", page_text, flags=re.M)), text


def test_the_whole_file_of_two_levels_is_read_by_library_and_reference_and_is_what_we_write():
    data, heights, _, _ = whole_file()
    with terrainwave.open(data) as terrain:
        assert list(terrain.check()) == []
        np.testing.assert_array_equal(terrain.read(), heights)
    np.testing.assert_array_equal(decode(data)[0], heights)
    expected = read_file(data)
    found = read_file(twz_bytes(heights.astype("uint8"), max_error=0, method="store", mesh="none"))
    assert found.payloads == expected.payloads
    assert found.codes == expected.codes
    assert expected.metadata == {"software": "terrainwave 1.0.0"}


def test_the_whole_file_has_the_stated_page_boxes_and_indices():
    data, _, columns, text = whole_file()
    assert page_of(data) == (bytes(8), b"".join(cells for cells, _ in columns))
    boxes = {block: [low, high] for block, (low, high, _) in block_codes(data).items()}
    stated = re.findall(r"block \((\d, \d, \d)\) has \[.*?\] = \[(−?\d+), (−?\d+)\]", text, re.I)
    assert len(stated) == 2
    for block, *box in stated:
        found = boxes[tuple(map(int, block.split(", ")))]
        assert found == [int(number.replace("−", "-")) for number in box]
    assert boxes[0, 0, 0] == [-14, 14]
    payloads = read_file(data).payloads
    root, first_row, second_row = (
        [int(number) for number in numbers.split()]
        for numbers in re.findall(r": ((?:\d+ ){16,}\d+)\.", text)
    )
    for key, indices in ((ROOT_KEY, root), ((0, 0, 0), first_row + second_row)):
        bits = "".join(f"{byte:08b}" for byte in payloads[key][6:])
        assert payloads[key][:6] == bytes([0, 0, 0, 0, 0, 5])
        assert [int(bits[5 * i : 5 * i + 5], 2) for i in range(len(indices))] == indices
        assert len(bits) - 5 * len(indices) in (3, 1)


def test_digests_of_the_file_are_the_stated_ones():
    tile, top, root = re.findall(r"`([0-9a-f]{64})`", section("4.9"))
    file = read_file(FILE)
    heights, mask = decode(FILE)
    found = digests.digests_of(heights, mask)
    assert [found[0, 0, 0].hex(), found[1, 0, 0].hex()] == [tile, top]
    assert digests.root_of(file.header, file.metadata, "int16", bytes.fromhex(top)) == root
    with terrainwave.open(FILE) as terrain:
        assert list(terrain.check(root)) == []
