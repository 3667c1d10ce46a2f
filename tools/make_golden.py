"""Write the golden files of the current format version: ``python tools/make_golden.py``.

It also renews the checksum of the worked example's header (FORMAT.md §9.2), which the version is
part of.

Files that exist are left as they are, and so is what the manifest says of them: to make one anew,
remove both. The table of tests/golden/README.md is written anew.
"""

import json
import re
import sys
import zlib
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]

import golden_files  # noqa: E402
from conformance import invalid, rapid  # noqa: E402
from conformance.editor import Editor, optional_section  # noqa: E402
from rasterio.transform import Affine  # noqa: E402
from strategies import write_geotiff  # noqa: E402
from twz import grouped  # noqa: E402

import terrainwave  # noqa: E402
from terrainwave.container.header import FORMAT_VERSION  # noqa: E402

PLACE = {"transform": Affine(30.0, 0.0, 4e5, 0.0, -30.0, 4e6), "crs": "EPSG:32611"}
DEGREES = {"transform": Affine(0.25, 0.0, -10.0, 0.0, -0.25, 50.0), "crs": "EPSG:4326"}


def terrain(n_rows, n_cols, amplitude):
    """Return hills with some roughness, by whole numbers alone: the same on every machine."""
    row, col = np.indices((n_rows, n_cols), dtype=np.int64)
    waves = np.zeros((n_rows, n_cols), dtype=np.int64)
    for period, down, across in ((61, 3, 2), (37, -1, 4), (23, 2, -1)):
        phase = (down * row + across * col) % (2 * period)
        ramp = np.minimum(phase, 2 * period - phase)
        waves += ramp * (period - ramp) * 4 * amplitude // (period * period) // 2
    rough = (row * 7919 + col * 104729 + (row * col) % 911) % 13 - 6
    return waves + rough * amplitude // 200


def town(n_rows, n_cols, amplitude):
    """Return hills with houses, whose edges no stencil foretells, by whole numbers alone."""
    heights = terrain(n_rows, n_cols, amplitude // 4)
    state = 1
    for _ in range(n_rows * n_cols // 100):
        drawn = []
        for n in (n_rows - 2, n_cols - 2, 4, 4, amplitude):
            state = state * 6364136223846793005 + 1442695040888963407 & (1 << 64) - 1
            drawn.append((state >> 33) % n)
        row, col, rows, cols, tall = drawn
        heights[row : row + rows + 2, col : col + cols + 2] += tall
    return heights


def plateaus(n_rows, n_cols, amplitude):
    """Return two plains, one far above the other."""
    heights = terrain(n_rows, n_cols, amplitude)
    heights[:, n_cols // 2 :] += 100_000
    return heights


def rubble(n_rows, n_cols, amplitude):
    """Return a plane of which only the samples of the finest level are rough, without any order."""
    row, col = np.indices((n_rows, n_cols), dtype=np.int64)
    state = (row * n_cols + col) * 2862933555777941757 + 3037000493
    for _ in range(3):
        state = (state ^ (state >> 29)) * 3202034522624059733
    rough = (state >> 33) % (2 * amplitude + 1) - amplitude
    return row + col + np.where((row | col) & 1, rough, 0)


def voids(n_rows, n_cols):
    """Return validity: a lake, a corner and single samples are void."""
    row, col = np.indices((n_rows, n_cols))
    valid = (row - n_rows // 3) ** 2 + (col - n_cols // 2) ** 2 > (n_rows // 6) ** 2
    valid &= row + 2 * col > n_rows // 4
    return valid & ((row * 31 + col * 17) % 97 != 0)


# name: (shape, type, amplitude, kind of voids, place and bands, options of compress)
CASES = {
    "predictive-int16-halves": ((75, 68), "int16", 900, "none", PLACE, {"max_error": 2}),
    "predictive-int16-lossless": ((40, 51), "int16", 400, "none", PLACE, {"max_error": 0}),
    "predictive-int16-nodata-zerotree": (
        (45, 70), "int16", 900, "nodata", PLACE, {"max_error": 3, "mesh": "zerotree"},
    ),
    "predictive-int16-nodata-rqt": (
        (45, 70), "int16", 900, "nodata", PLACE, {"max_error": 3, "mesh": "rqt"},
    ),
    "predictive-uint8-best": (
        (41, 41), "uint8", 80, "none", DEGREES, {"max_error": 1, "effort": "best", "mesh": "none"},
    ),
    "predictive-uint16-mask": ((44, 39), "uint16", 900, "mask", PLACE, {"max_error": 1}),
    "predictive-int32-rings": (
        (50, 66), "int32", 90_000, "none", PLACE,
        {"max_error": 50, "border_rings": 3, "mesh": "none"},
    ),
    "predictive-float32-nan": ((40, 60), "float32", 500, "nan", PLACE, {"max_error": 0.1}),
    "predictive-float64-scaled": (
        (39, 40), "float64", 500, "none", PLACE | {"bands": {"scales": 0.1, "offsets": 7.0}},
        {"max_error": 0.25, "mesh": "none"},
    ),
    "predictive-fast-blocks": (
        (70, 70), "int16", 700, "nodata", PLACE,
        {"max_error": 5, "effort": "fast", "block": 64, "mesh": "none"},
    ),
    "rapid-int16-halves": (
        (110, 100), "int16", 900, "none", PLACE, {"max_error": 2, "method": "rapid"},
    ),
    "rapid-int16-lossless": (
        (100, 110), "int16", 20, "none", PLACE, {"max_error": 0, "method": "rapid", "mesh": "none"},
    ),
    "rapid-int16-lossless-nodata": (
        (70, 51), "int16", 400, "nodata", PLACE, {"max_error": 0, "method": "rapid"},
    ),
    "rapid-int16-states": (
        (133, 130), "int16", 300, "nodata", PLACE,
        {"max_error": 8, "method": "rapid", "block": 64, "mesh": "none"},
    ),
    "rapid-int16-blocks": (
        (70, 66), "int16", 300, "nodata", PLACE,
        {"max_error": 1, "method": "rapid", "block": 64, "mesh": "none"},
    ),
    "rapid-int16-mask": (
        (100, 110), "int16", 60, "mask", PLACE,
        {"max_error": 3, "method": "rapid", "mesh": "none"},
    ),
    "rapid-int16-town": (
        (80, 75), "int16", 160, "nodata", PLACE,
        {"max_error": 1, "method": "rapid", "mesh": "none", "relief": town},
    ),
    # A group of more bytes than a band has, below a smooth root block.
    "rapid-int16-bands": (
        (129, 128), "int16", 420, "none", PLACE,
        {"max_error": 0, "method": "rapid", "block": 64, "mesh": "none", "relief": rubble},
    ),
    "rapid-uint8": (
        (41, 41), "uint8", 80, "none", DEGREES,
        {"max_error": 1, "method": "rapid", "mesh": "none"},
    ),
    "rapid-uint8-root": (
        (9, 14), "uint8", 80, "none", DEGREES,
        {"max_error": 0, "method": "rapid", "mesh": "none"},
    ),
    "rapid-int32-mask": (
        (50, 65), "int32", 90_000, "mask", PLACE,
        {"max_error": 50, "method": "rapid", "mesh": "none"},
    ),
    "rapid-int32-wide": (
        (50, 46), "int32", 4_000_000, "none", PLACE,
        {"max_error": 3, "method": "rapid", "mesh": "none"},
    ),
    "rapid-int32-origins": (
        (60, 132), "int32", 30, "none", PLACE,
        {"max_error": 1, "method": "rapid", "mesh": "none", "relief": plateaus},
    ),
    "rapid-int32-large-step": (
        (50, 46), "int32", 9_000_000, "none", PLACE,
        {"max_error": 9000, "method": "rapid", "mesh": "none", "relief": town},
    ),
    "rapid-float32-nan": (
        (40, 60), "float32", 500, "nan", PLACE, {"max_error": 0.1, "method": "rapid"},
    ),
    "rapid-float32-fills": (
        (45, 70), "float32", 500, "nan", PLACE,
        {"max_error": 1, "method": "rapid", "mesh": "none"},
    ),
    "rapid-float32-exact": (
        (45, 51), "float32", 400, "nan", PLACE, {"max_error": 0, "method": "rapid"},
    ),
    "rapid-one-row": (
        (1, 140), "int16", 200, "nodata", PLACE,
        {"max_error": 1, "method": "rapid", "mesh": "none"},
    ),
    "rapid-one-column": (
        (140, 1), "int16", 300, "nodata", PLACE,
        {"max_error": 1, "method": "rapid", "mesh": "none"},
    ),
    "rapid-two-columns": (
        (75, 2), "int16", 300, "nodata", PLACE,
        {"max_error": 2, "method": "rapid", "mesh": "none"},
    ),
    "predictive-float64-exact": (
        (34, 36), "float64", 900, "none", PLACE, {"max_error": 0, "mesh": "none"},
    ),
    "cdf53-int16-lossless": (
        (66, 47), "int16", 900, "nodata", PLACE, {"max_error": 0, "method": "cdf53"},
    ),
    "cdf53-int16-nodata-rqt-coefficient": (
        (66, 47), "int16", 900, "nodata", PLACE,
        {"max_error": 3, "method": "cdf53", "mesh": "rqt-coefficient"},
    ),
    "cdf53-uint16-rate": (
        (70, 75), "uint16", 900, "none", PLACE, {"rate": 4.0, "method": "cdf53", "mesh": "none"},
    ),
    "cdf97-int16-halves": (
        (75, 68), "int16", 900, "none", PLACE, {"max_error": 2, "method": "cdf97"},
    ),
    "cdf97-float32-nan-zerotree": (
        (40, 60), "float32", 500, "nan", PLACE,
        {"max_error": 1, "method": "cdf97", "mesh": "zerotree-plain"},
    ),
    # Clipped blocks, voids, aprons; heights so smooth that few nodes are significant.
    "cdf97-int16-mask-zerotree-layer": (
        (109, 86), "int16", 150, "mask", PLACE,
        {"max_error": 4, "method": "cdf97", "mesh": "zerotree", "border_rings": 3},
    ),
    "cdf97-uint16-mask-rqt": (
        (44, 39), "uint16", 900, "mask", PLACE,
        {"max_error": 4, "method": "cdf97", "mesh": "rqt"},
    ),
    "cdf97-int32-rings": (
        (50, 66), "int32", 90_000, "none", PLACE,
        {"max_error": 99, "method": "cdf97", "border_rings": 3, "mesh": "none"},
    ),
    "cdf97-int16-nodata-faithful": (
        (70, 66), "int16", 900, "nodata", PLACE,
        {"max_error": 5, "method": "cdf97", "faithful": True, "mesh": "zerotree"},
    ),
    "cdf97-int32-rings-faithful": (
        (50, 66), "int32", 90_000, "none", PLACE,
        {
            "max_error": 99, "method": "cdf97", "faithful": True, "border_rings": 3,
            "mesh": "none",
        },
    ),
    "store-int16-nodata-halves": (
        (36, 35), "int16", 900, "nodata", PLACE, {"max_error": 0, "method": "store"},
    ),
    "store-float64-rqt": (
        (34, 37), "float64", 500, "nan", PLACE,
        {"max_error": 0.01, "method": "store", "mesh": "rqt"},
    ),
    "store-int16-segments": (
        (1100, 2), "int16", 60, "nodata", PLACE,
        {"max_error": 3, "method": "store", "mesh": "none"},
    ),
    "rapid-int16-declared": (
        (50, 51), "int16", 400, "declared", PLACE,
        {"max_error": 2, "method": "rapid", "mesh": "none"},
    ),
    "predictive-float32-rings": (
        (45, 70), "float32", 500, "nan", PLACE,
        {"max_error": 1, "border_rings": 3, "mesh": "none"},
    ),
    "cdf53-int16-tiles": (
        (1100, 3), "int16", 300, "mask", PLACE,
        {"max_error": 9, "method": "cdf53", "mesh": "none"},
    ),
    # Corrections, of files that were patched so often.
    "rapid-patched-int16-nodata": (
        (70, 66), "int16", 400, "nodata", PLACE,
        {"max_error": 5, "method": "rapid", "patches": 3},
    ),
    "rapid-patched-int32-wide": (
        (40, 37), "int32", 4_000_000, "none", PLACE,
        {"max_error": 9000, "method": "rapid", "mesh": "none", "patches": 4},
    ),
    "predictive-patched-int16-rings": (
        (75, 110), "int16", 900, "nodata", PLACE,
        {"max_error": 40, "border_rings": 3, "mesh": "none", "patches": 4},
    ),
    "predictive-patched-float32-nan": (
        (70, 66), "float32", 500, "nan", PLACE, {"max_error": 0.5, "mesh": "none", "patches": 2},
    ),
    # Three leaves, the middle one void, and void tiles; segments of three levels.
    "store-digests-int16": (
        (3, 8200), "int16", 900, "gap", PLACE,
        {"max_error": 0, "method": "store", "mesh": "none", "digest": True},
    ),
    "rapid-digests-float32": (
        (70, 66), "float32", 500, "nan",
        PLACE | {"bands": {"scales": 0.5, "offsets": -0.0}},
        {"max_error": 0.5, "method": "rapid", "mesh": "none", "digest": True},
    ),
    "one-sample": ((1, 1), "int16", 100, "none", DEGREES, {"max_error": 0}),
    "one-row": ((1, 90), "float32", 100, "none", DEGREES, {"max_error": 0.5}),
    "all-void": ((70, 40), "int16", 100, "all", DEGREES, {"max_error": 1}),
}  # fmt: skip


# What a reader shows by decoding the file.
EXERCISES = {
    "predictive-int16-halves": "two levels of groups, lossy, shared lines, meshes `halves`",
    "predictive-int16-lossless": "step 1",
    "predictive-int16-nodata-zerotree": "voids by nodata, labels of `zerotree-plain`",
    "predictive-int16-nodata-rqt": "voids by nodata, flags of `rqt`",
    "predictive-uint8-best": "tables of the file's own (P.10)",
    "predictive-uint16-mask": "a mask of its own, no nodata: voids are 0",
    "predictive-int32-rings": "aprons (border_rings 3), a large step",
    "predictive-float32-nan": "decimals, voids are NaN",
    "predictive-float64-scaled": "scale and offset; quantum_den above 1",
    "predictive-fast-blocks": "blocks of 64; payloads without *mixed*",
    "rapid-int16-halves": "three levels, shared lines (R.3), tables of the file's own (R.10)",
    "rapid-int16-lossless": "step 1, pairs and samples alone",
    "rapid-int16-lossless-nodata": "step 1, voids by nodata",
    "rapid-int16-states": "eight states, blocks of 64, voids",
    "rapid-int16-blocks": "step 3, blocks of 64, voids by nodata",
    "rapid-int16-mask": "a mask of its own, pairs of which one sample is void",
    "rapid-int16-town": "cliffs in gentle ground: samples that go on (R.9)",
    "rapid-int16-bands": "rough ground, raw bits beside symbols",
    "rapid-uint8": "a step of 3, degrees",
    "rapid-uint8-root": "a root block alone, parameters of one byte",
    "rapid-int32-mask": "a mask of its own, a large step",
    "rapid-int32-wide": "heights that are not narrow: levels with a shift (R.2)",
    "rapid-int32-origins": "narrow groups far apart: origins off the middle (R.2)",
    "rapid-int32-large-step": "a step that no narrow unit has, cliffs",
    "rapid-float32-nan": "decimals, voids are NaN",
    "rapid-float32-fills": "fills (§5.2) beside details of voids",
    "rapid-float32-exact": "remainders (§5.3) of 4 bytes, NaN",
    "rapid-one-row": "planes HH and LH without samples (R.5), voids",
    "rapid-one-column": "planes HH and HL without samples",
    "rapid-two-columns": "planes of one column, an odd end of each row",
    "predictive-float64-exact": "remainders of 8 bytes",
    "cdf53-int16-lossless": "whole streams, masks of tiles",
    "cdf53-int16-nodata-rqt-coefficient": "meshes by coefficients (mesh 6), voids",
    "cdf53-uint16-rate": "streams that are cut",
    "cdf97-int16-halves": "coefficients and residuals, three levels",
    "cdf97-float32-nan-zerotree": "decimals, NaN, `zerotree-plain`",
    "cdf97-int16-mask-zerotree-layer": "aprons, a mask, zero trees of difference layers (mesh 4)",
    "cdf97-uint16-mask-rqt": "a mask of its own, `rqt`",
    "cdf97-int32-rings": "aprons, a large step",
    "cdf97-int16-nodata-faithful": "feature bit 2 (§7.9), coded zero trees (mesh 5)",
    "cdf97-int32-rings-faithful": "feature bit 2 with aprons",
    "store-int16-nodata-halves": "the smallest method, voids by nodata",
    "store-float64-rqt": "decimals of float64, NaN",
    "store-int16-segments": "six levels: several segments, absent ones (§3.4)",
    "rapid-int16-declared": "a nodata value and no void: no feature bit 0",
    "predictive-float32-rings": "fills (§5.2), aprons, NaN",
    "cdf53-int16-tiles": "fills of tiles of several levels, one below the other (C.4)",
    "rapid-patched-int16-nodata": "corrections (feature bit 3, §5.4) beside voids",
    "rapid-patched-int32-wide": "corrections of a root block, heights that are not narrow (R.2)",
    "predictive-patched-int16-rings": "corrections with raw bits of magnitudes, aprons, voids",
    "predictive-patched-float32-nan": "corrections, a large step, voids are NaN",
    "store-moved-decimal": "`moved` written 3.0 (§4.2)",
    "store-optional-sections": "two optional sections of the header (§4.8), one of them empty",
    "store-digests-int16": "digests (feature bit 4, §4.9) of three leaves, one of them void",
    "rapid-digests-float32": "digests of heights of a lossy file, voids, CRS and unit",
    "rapid-above-float32": "one-sided bound: `bound` above, *base* off the middle (§4.2)",
    "rapid-no-parameters": "an empty parameters section (R.10)",
    "rapid-empty-bands": "bands that have no strip (R.9)",
    "rapid-not-narrow": "heights that narrow units could have in others, without a shift (R.1)",
    "rapid-drawn-narrow": "details of anything: of voids, beyond all limits (R.7, R.9); any tables",
    "rapid-drawn-wide": "the same, with a shift, an origin far off the middle and three bands",
    "one-sample": "a raster of one sample",
    "one-row": "a raster of one row",
    "all-void": "no valid sample: z_min 0, z_max −1, empty payloads",
}


def write_case(path, shape, dtype, amplitude, kind, profile, options):
    """Write one golden file."""
    options = dict(options)
    heights = options.pop("relief", terrain)(*shape, amplitude).astype(dtype)
    if np.dtype(dtype).kind == "f":
        divisor = 3 if path.stem.endswith("exact") else 8  # on no vertical grid, or on one
        heights = heights / np.asarray(divisor, dtype=dtype)
    mask, nodata = None, None
    valid = np.zeros(shape, dtype=bool) if kind == "all" else voids(*shape)
    if kind == "declared":
        valid = np.ones(shape, dtype=bool)
    if kind in ("nodata", "all", "declared"):
        nodata = -9999
        heights = np.where(valid, heights, nodata).astype(dtype)
    elif kind == "gap":
        col = np.arange(shape[1])
        nodata = -9999
        heights[:, (col >= 600) & (col < 8192)] = nodata
    elif kind == "nan":
        heights = np.where(valid, heights, np.nan).astype(dtype)
    elif kind == "mask":
        mask = valid
    raster = path.with_suffix(".tif")
    try:
        write_geotiff(raster, heights, mask=mask, nodata=nodata, units=("m",), **profile)
        usual = {"block": 32, "mesh": "halves", "method": "predictive", "digest": False}
        options = usual | options
        n_patches = options.pop("patches", 0)
        terrainwave.compress(raster, path, threads=1, overwrite=True, **grouped(options))
        for number in range(n_patches):
            write_patch(raster, heights, valid if kind != "none" else None, number, nodata, profile)
            terrainwave.patch(path, raster, threads=1)
    finally:
        raster.unlink(missing_ok=True)


def write_patch(raster, heights, valid, number, nodata, profile):
    """Write a part of a raster whose heights have sunk or risen, within their range."""
    n_rows, n_cols = heights.shape
    row, col = (29 * number + 5) % (n_rows - 20), (43 * number + 11) % (n_cols - 20)
    at = slice(row, row + 17 + 5 * number), slice(col, col + 27 - 4 * number)
    stays = np.ones(heights.shape, dtype=bool) if valid is None else valid
    lowest, highest = heights[stays].min(), heights[stays].max()
    part = np.where(stays, heights, 0)[at].astype(np.float64)
    step = int(highest - lowest) // 40 * (1 if number % 2 else -1)
    ramp = np.arange(part.shape[0])[:, None] % 9 + np.arange(part.shape[1]) % 7
    part = np.clip(part + step + ramp * step // 8, lowest, highest)
    part = np.where(stays[at], part, heights[at]).astype(heights.dtype)
    place = profile["transform"] @ Affine.translation(col, row)
    write_geotiff(raster, part, nodata=nodata, units=("m",), **profile | {"transform": place})


def renew_example():
    """Put the headers' checksums into the whole files of FORMAT.md (§9.2, §9.7)."""
    path = ROOT / "docs" / "FORMAT.md"
    text = path.read_text(encoding="utf-8")
    for heading in ("### 9.2 ", "#### A whole file "):
        start = text.index(heading)
        rows = re.findall(r"^\| \d+ \| ([0-9a-f]{2}(?: [0-9a-f]{2})*) \|", text[start:], re.M)
        crc = zlib.crc32(b"".join(map(bytes.fromhex, rows))[:124])
        row = f"| 124 | {crc.to_bytes(4, 'little').hex(' ')} | header_crc 0x{crc:08X} |"
        pattern = r"^\| 124 \| [0-9a-f ]+ \| header_crc .*$"
        text = text[:start] + re.sub(pattern, row, text[start:], count=1, flags=re.M)
    path.write_text(text, encoding="utf-8")


def write_manifest(path, manifest):
    """Write the manifest; after each file, so that an interrupted run goes on where it was."""
    path.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")


def table(head, rows):
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


def write_readme(manifest):
    """Write the tables of what the files are into README.md beside them."""
    path = golden_files.GOLDEN / "README.md"
    text = path.read_text(encoding="utf-8")
    files = table(
        ["file", "rows × columns", "levels", "dtype", "method", "mesh", "what it exercises"],
        [
            [
                f"`{name}`", f"{entry['rows']} × {entry['cols']}", entry["levels"], entry["dtype"],
                entry["method"], entry["mesh"], entry["exercises"],
            ]
            for name, entry in manifest["files"].items()
        ],
    )  # fmt: skip
    wrong = table(
        ["file", "clause", "what is wrong", "rejected as", "found by a reader of"],
        [
            [f"`{name}`", entry["clause"], entry["fault"], entry["outcome"], entry["found_by"]]
            for name, entry in manifest["invalid"].items()
        ],
    )
    for name, content in (("files", files), ("invalid", wrong)):
        head, _, rest = text.partition(f"<!-- {name} -->\n")
        text = f"{head}<!-- {name} -->\n{content}<!-- end -->{rest.partition('<!-- end -->')[2]}"
    path.write_text(text, encoding="utf-8")


def write_retold(path, name, edit):
    """Write a golden file that is another but for one change."""
    editor = Editor(path.with_name(f"{name}.twz").read_bytes())
    edit(editor)
    path.write_bytes(editor.bytes())


def add_sections(editor):
    """Add optional sections."""
    editor.optional = optional_section(b"none", b"what no reader knows")
    editor.optional += optional_section(b"void", b"")


def be_above(editor):
    """Say that all heights are above the originals: the middle of steps lies half a step higher."""
    editor.set_json(bound="above")
    h = editor.fields
    editor.header = {"base": h["base"] + h["step"] // 2}
    editor.header |= {name: 2 * h[name] for name in ("max_error", "effective_bound")}


def be_drawn(seed, span, step):
    """Return an edit that gives units of rapid bytes of anything, and a file its own tables."""

    def edit(editor):
        editor.header |= {"z_min": -span, "z_max": span + 1, "step": step}
        editor.parameters = rapid.random_section(np.random.default_rng(seed))
        rapid.draw_payloads(editor, seed)

    return edit


def without_parameters(editor):
    """Let the parameters of rapid follow from the step: those of one byte of a root block."""
    assert len(editor.parameters) == 1
    editor.parameters = b""


def with_payloads(edit, keys=None):
    """Return an edit of the bytes of rapid in the payloads of keys, or all."""

    def edit_file(editor):
        for key in keys or editor.top.payloads:
            data = editor.top.payloads[key]
            own = rapid.own_bytes(data)
            found = rapid.Payload(own)
            edit(found)
            editor.top.payloads[key] = data[: len(data) - len(own)] + found.bytes()

    return edit_file


RETOLD = {
    "rapid-above-float32": ("rapid-float32-fills", be_above),
    "rapid-no-parameters": ("rapid-uint8-root", without_parameters),
    "rapid-empty-bands": (
        "rapid-one-row", with_payloads(lambda found: found.add_bands(3), [(0, 0, 0)]),
    ),
    "rapid-not-narrow": (
        "rapid-int16-lossless-nodata", with_payloads(lambda found: found.set_wide(0)),
    ),
    "rapid-drawn-narrow": ("rapid-int32-mask", be_drawn(1, 9000, 1)),
    "rapid-drawn-wide": ("rapid-int32-mask", be_drawn(6, 2**28, 5)),
    "store-moved-decimal": ("store-int16-nodata-halves", lambda editor: editor.set_json(moved=3.0)),
    "store-optional-sections": ("store-int16-nodata-halves", add_sections),
}  # fmt: skip


def main():
    """Write files that are missing, and what the manifest does not say of them yet."""
    directory = golden_files.GOLDEN / f"v{FORMAT_VERSION}"
    (directory / "invalid").mkdir(parents=True, exist_ok=True)
    manifest_path = directory / "manifest.json"
    manifest = {"format_version": FORMAT_VERSION, "files": {}, "invalid": {}}
    if manifest_path.exists():
        manifest = json.loads(manifest_path.read_text(encoding="utf-8"))
    for name, case in (CASES | RETOLD).items():
        path = directory / f"{name}.twz"
        if not path.exists():
            (write_retold if name in RETOLD else write_case)(path, *case)
            print(f"{path.relative_to(ROOT)}: {path.stat().st_size:,} bytes")
        if path.name not in manifest["files"]:
            found = {"exercises": EXERCISES[name]} | golden_files.found(path)
            manifest["files"][path.name] = found
            write_manifest(manifest_path, manifest)
    for name, case in invalid.CASES.items():
        path = directory / "invalid" / f"{name}.twz"
        if not path.exists():
            path.write_bytes(case.bytes())
        if path.name not in manifest["invalid"]:
            manifest["invalid"][path.name] = golden_files.found_invalid(path)
    write_manifest(manifest_path, manifest)
    write_readme(manifest)
    total = sum(path.stat().st_size for path in directory.rglob("*.twz"))
    renew_example()
    print(f"{len(manifest['files'])} files and {len(manifest['invalid'])} invalid, {total:,} bytes")


if __name__ == "__main__":
    main()
