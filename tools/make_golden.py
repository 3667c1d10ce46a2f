"""Write the golden files of the current format version: ``python tools/make_golden.py``.

It also renews the checksum of the worked example's header (FORMAT.md §9.2), which the version is
part of.

Files that exist are left as they are: what a version wrote once must stay readable. ``--replace``
makes all files of the current version anew, for as long as it is not released.
"""

import argparse
import json
import re
import sys
import zlib
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]

import golden_files  # noqa: E402
from rasterio.transform import Affine  # noqa: E402
from strategies import write_geotiff  # noqa: E402

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
    # As above, of writers that no longer measure the finest meshes.
    "predictive-int16-halves-bounded": (
        (75, 68), "int16", 900, "none", PLACE, {"max_error": 2},
    ),
    "predictive-int16-nodata-zerotree-bounded": (
        (45, 70), "int16", 900, "nodata", PLACE, {"max_error": 3, "mesh": "zerotree"},
    ),
    "predictive-int16-nodata-rqt-bounded": (
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
    "rapid-int16-lossless-nodata": (
        (70, 51), "int16", 400, "nodata", PLACE, {"max_error": 0, "method": "rapid"},
    ),
    # Units of so many samples that they have eight states.
    "rapid-int16-states": (
        (133, 130), "int16", 300, "nodata", PLACE,
        {"max_error": 8, "method": "rapid", "block": 64, "mesh": "none"},
    ),
    "rapid-uint8": (
        (41, 41), "uint8", 80, "none", DEGREES,
        {"max_error": 1, "method": "rapid", "mesh": "none"},
    ),
    "rapid-int32-rings": (
        (50, 66), "int32", 90_000, "mask", PLACE,
        {"max_error": 50, "method": "rapid", "border_rings": 3, "mesh": "none"},
    ),
    "rapid-int32-wide": (
        (50, 46), "int32", 4_000_000, "none", PLACE,
        {"max_error": 3, "method": "rapid", "mesh": "none"},
    ),
    "rapid-float32-nan": (
        (40, 60), "float32", 500, "nan", PLACE, {"max_error": 0.1, "method": "rapid"},
    ),
    "rapid-float32-exact": (
        (45, 51), "float32", 400, "nan", PLACE, {"max_error": 0, "method": "rapid"},
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
    "one-sample": ((1, 1), "int16", 100, "none", DEGREES, {"max_error": 0}),
    "one-row": ((1, 90), "float32", 100, "none", DEGREES, {"max_error": 0.5}),
    "all-void": ((70, 40), "int16", 100, "all", DEGREES, {"max_error": 1}),
}  # fmt: skip


def write_case(path, shape, dtype, amplitude, kind, profile, options):
    """Write one golden file."""
    heights = terrain(*shape, amplitude).astype(dtype)
    if np.dtype(dtype).kind == "f":
        divisor = 3 if path.stem.endswith("exact") else 8  # on no vertical grid, or on one
        heights = heights / np.asarray(divisor, dtype=dtype)
    mask, nodata = None, None
    valid = np.zeros(shape, dtype=bool) if kind == "all" else voids(*shape)
    if kind in ("nodata", "all"):
        nodata = -9999
        heights = np.where(valid, heights, nodata).astype(dtype)
    elif kind == "nan":
        heights = np.where(valid, heights, np.nan).astype(dtype)
    elif kind == "mask":
        mask = valid
    raster = path.with_suffix(".tif")
    try:
        write_geotiff(raster, heights, mask=mask, nodata=nodata, units=("m",), **profile)
        options = {"block": 32, "mesh": "halves", "method": "predictive"} | options
        terrainwave.compress(raster, path, threads=1, overwrite=True, **options)
    finally:
        raster.unlink(missing_ok=True)


def renew_example():
    """Put the header's checksum into the worked example of FORMAT.md."""
    path = ROOT / "docs" / "FORMAT.md"
    text = path.read_text(encoding="utf-8")
    start = text.index("### 9.2 ")
    rows = re.findall(r"^\| \d+ \| ([0-9a-f]{2}(?: [0-9a-f]{2})*) \|", text[start:], re.M)
    crc = zlib.crc32(b"".join(map(bytes.fromhex, rows))[:124])
    row = f"| 124 | {crc.to_bytes(4, 'little').hex(' ')} | header_crc 0x{crc:08X} |"
    path.write_text(
        re.sub(r"^\| 124 \| [0-9a-f ]+ \| header_crc .*$", row, text, flags=re.M), encoding="utf-8"
    )


def write_manifest(path, manifest):
    """Write the manifest; after each file, so that an interrupted run goes on where it was."""
    path.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")


def main():
    """Write files that are missing, or all, and the manifest."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replace", action="store_true", help="make all of this version anew")
    replace = parser.parse_args().replace
    directory = golden_files.GOLDEN / f"v{FORMAT_VERSION}"
    directory.mkdir(parents=True, exist_ok=True)
    manifest_path = directory / "manifest.json"
    manifest = {}
    if manifest_path.exists() and not replace:
        manifest = json.loads(manifest_path.read_text(encoding="utf-8"))
    for name, case in CASES.items():
        path = directory / f"{name}.twz"
        if path.name in manifest:
            continue
        write_case(path, *case)
        manifest[path.name] = golden_files.digests(path)
        write_manifest(manifest_path, manifest)
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size:,} bytes")
    for path in sorted(directory.glob("*.twz")):
        if path.name not in manifest:
            path.unlink()
    total = sum(path.stat().st_size for path in directory.glob("*.twz"))
    renew_example()
    print(f"{len(manifest)} files, {total:,} bytes")


if __name__ == "__main__":
    main()
