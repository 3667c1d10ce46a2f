"""Write the annexes of the methods as data of the JavaScript reader: js/src/*-data.js.

python tools/make_js_tables.py
"""

import base64
import json
import zlib
from pathlib import Path

import numpy as np

from terrainwave.codec.predictive import trained as tables
from terrainwave.codec.rapid import trained as rapid_tables
from terrainwave.codec.rapid import trained_reach as rapid_reach_tables

OUT = Path(__file__).parents[1] / "js" / "src"
WIDTH = 100


def constant(name, value):
    """Return a constant of nested lists of numbers, wrapped."""
    words = json.dumps(value, separators=(",", ":")).replace(",", ", ").split(" ")
    lines, line = [], " "
    for word in words:
        if len(line) + 1 + len(word) > WIDTH:
            lines.append(line)
            line = " "
        line += " " + word
    return f"export const {name} =\n" + "\n".join([*lines, line]) + ";\n"


def packed(name, data):
    """Return a constant of bytes: a zlib stream in base 64, in lines."""
    text = base64.b64encode(zlib.compress(data, 9)).decode()
    parts = [text[i : i + WIDTH - 8] for i in range(0, len(text), WIDTH - 8)]
    lines = "\n".join(f'  "{part}" +' for part in parts).removesuffix(" +")
    return f"/** {len(data)} bytes, deflated, in base 64. */\nexport const {name} =\n{lines};\n"


def module(section, *constants):
    """Return the text of a module of data."""
    head = f"/** {section}: written by tools/make_js_tables.py. */\n\n// prettier-ignore\n"
    return head + "\n// prettier-ignore\n".join(constants)


def rapid_data():
    """Return the module of the annexes of method rapid; the codes of both, one after the other."""
    stencils = [rapid_tables.STENCILS[plane].tolist() for plane in (1, 2, 3)]
    features = [table.tolist() for table in rapid_tables.FEATURES]
    modules = rapid_tables, rapid_reach_tables
    codes = b"".join(zlib.decompress(base64.b85decode(one._CODES)) for one in modules)
    return module(
        "The annexes of method rapid (format-rapid.md, R.10)",
        constant("STENCILS", stencils),
        constant("FEATURES", features),
        packed("CODES", codes),
    )


def predictive_data():
    """Return the module of the annex of method predictive."""
    stencils = [tables.STENCILS[plane].tolist() for plane in (1, 2, 3)]
    weights = [tables.E_WEIGHTS[plane].tolist() for plane in (1, 2, 3)]
    starts = np.frombuffer(zlib.decompress(base64.b85decode(tables._STARTS)), "<u2")
    return module(
        "The annex of method predictive (format-predictive.md, P.9)",
        constant("STENCILS", stencils),
        constant("E_WEIGHTS", weights),
        packed("STARTS", starts.tobytes()),
    )


if __name__ == "__main__":
    for name, text in (("rapid", rapid_data()), ("predictive", predictive_data())):
        (OUT / f"{name}-data.js").write_text(text, encoding="utf-8")
