"""Write the annexes of the format as data of the native library: native/src/tables.c.

python tools/make_native_tables.py

From the files of the annexes (FORMAT.md §15), and the mixer's functions from its text.
"""

import re
import zlib
from decimal import Decimal, localcontext
from pathlib import Path

from terrainwave.annexes import read_annex, read_tables
from terrainwave.codec import masks
from terrainwave.codec.cdf97 import trained as tables97
from terrainwave.codec.predictive import trained as tables
from terrainwave.codec.rapid import file_tables as rapid_tables

ROOT = Path(__file__).parents[1]
OUT = ROOT / "native" / "src" / "tables.c"
WIDTH = 100
HEAD = "/* The annexes of the format as data: written by tools/make_native_tables.py. */\n"


def block_of(name):
    """Return the lines of a block of FORMAT.md that is fenced as `name`."""
    text = (ROOT / "docs" / "FORMAT.md").read_text(encoding="utf-8")
    return re.search(rf"```{name}\n(.*?)\n```", text, re.DOTALL)[1].splitlines()


def nested(values, depth):
    """Return numbers as an initialiser with braces `depth` deep."""
    if depth == 0:
        return str(int(values))
    return "{" + ", ".join(nested(value, depth - 1) for value in values) + "}"


def wrapped(text):
    """Return text broken at blanks into lines that fit."""
    lines, line = [], "   "
    for word in text.split(" "):
        if len(line) + 1 + len(word) > WIDTH:
            lines.append(line)
            line = "   "
        line += " " + word
    return "\n".join([*lines, line])


def array(declared, values, depth=1):
    """Return a constant array of numbers."""
    return f"const {declared} =\n{wrapped(nested(values, depth))};\n"


def packed(name, data):
    """Return bytes as a zlib stream, and how many it has."""
    stream = zlib.compress(data, 9)
    return array(f"uint8_t {name}[{len(stream)}]", stream), len(stream)


def text_of(name, text):
    """Return a constant of characters."""
    lines = [text[i : i + 160] for i in range(0, len(text), 160)]
    parts = "\n".join('    "' + re.sub(r'([\\"])', r"\\\1", line) + '"' for line in lines)
    return f"const char {name}[] =\n{parts};\nconst size_t {name}_size = {len(text)};\n"


def stencils(name, annex):
    """Return the stencils of a method by plane; taps that a plane lacks are 0."""
    sets = [[[*row, *[0] * (24 - len(row))] for row in annex[p].tolist()] for p in (1, 2, 3)]
    return array(f"int16_t {name}[3][{len(sets[0])}][24]", sets, 3)


def nearest(x):
    """Return the whole number nearest to a decimal; none lies near a half (P.1)."""
    assert abs(x - x.to_integral_value(rounding="ROUND_FLOOR") - Decimal("0.5")) > Decimal("1e-7")
    return int(x.to_integral_value(rounding="ROUND_HALF_EVEN"))


def mixer():
    """Return S and T of P.1."""
    with localcontext() as context:
        context.prec = 40
        s = [nearest(256 * (Decimal(2 * k + 1) / Decimal(2047 - 2 * k)).ln()) for k in range(1024)]
        t = [nearest(65536 / (1 + (Decimal(703 - 2 * k) / 64).exp())) for k in range(704)]
    return array("int16_t twz_logits[1024]", s), array("uint16_t twz_mixed[704]", t)


def of_masks():
    """Return the frequencies of masks (§5.2)."""
    found = read_tables(masks.ANNEX, masks.LAYOUT)
    return [
        array("uint16_t twz_mask_samples[16][49]", found["samples"].tolist(), 2),
        array("uint16_t twz_mask_groups[7][13]", found["groups"].tolist(), 2),
    ]


def of_rapid():
    """Return the stencils of rapid, and its families, a stream for each (R.11)."""
    found = read_tables(rapid_tables.ANNEX, rapid_tables.LAYOUT)
    parts = [array("int16_t twz_rapid_stencils[3][16][24]", found["stencils"].tolist(), 3)]
    names, sizes = [], []
    for family in range(len(found["cuts"])):
        tables = [found[name][family].tobytes() for name in ("cuts", "weights", "pairs", "samples")]
        names.append(f"family_{family}")
        text, size = packed(names[-1], b"".join(tables))
        parts.append("static " + text)
        sizes.append(size)
    listed = "{" + ", ".join(names) + "}"
    parts.append(f"const uint8_t *const twz_rapid_families[{len(names)}] =\n{wrapped(listed)};\n")
    parts.append(array(f"size_t twz_rapid_families_size[{len(names)}]", sizes))
    return parts


def main():
    """Write the file."""
    parts = [
        HEAD + '#include "tables.h"\n',
        text_of("twz_dictionary", read_annex("dictionary.txt").decode("ascii")),
        *of_masks(),
        *of_rapid(),
        stencils("twz_predictive_stencils", tables.STENCILS),
        array(
            "int16_t twz_predictive_weights[3][3][18]",
            [tables.E_WEIGHTS[plane].tolist() for plane in (1, 2, 3)],
            3,
        ),
        *mixer(),
        array("int16_t twz_cdf97_terms[16][4][19]", tables97.TERM_WEIGHTS.tolist(), 3),
        array("int16_t twz_cdf97_weights[8]", tables97.E_WEIGHTS.tolist()),
    ]
    for method, annex, names in (
        ("predictive", tables, ["starts"]),
        ("cdf97", tables97, ["residuals", "trees", "border"]),
    ):
        found, name = read_tables(annex.ANNEX, annex.LAYOUT), f"twz_{method}_starts"
        text, size = packed(name, b"".join(found[part].tobytes() for part in names))
        parts += [text, f"const size_t {name}_size = {size};\n"]
    OUT.write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
