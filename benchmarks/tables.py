"""Write the measured tables into documents: ``python -m benchmarks.tables``.

Each table stands between ``<!-- table: NAME -->`` and ``<!-- end -->`` in a document and is made
from a CSV under ``benchmarks/results``. ``--check`` changes nothing and exits 1 if a document does
not say what its CSV says.
"""

import argparse
import csv
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
DOCUMENTS = ("README.md", "docs/benchmarks.md")
OURS = "terrainwave-cdf97"

Rows = list[dict[str, str]]


def read_rows(name: str) -> Rows:
    """Return the rows of ``benchmarks/results/NAME.csv``."""
    with (RESULTS / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def geometric_mean(values: list[float]) -> float:
    """Return the geometric mean of positive numbers."""
    return math.exp(sum(map(math.log, values)) / len(values))


def cases(rows: Rows) -> dict[tuple[str, str], dict[str, dict[str, str]]]:
    """Return the rows by (raster, bound) and codec."""
    found: dict[tuple[str, str], dict[str, dict[str, str]]] = {}
    for row in rows:
        found.setdefault((row["raster"], row["max_error"]), {})[row["codec"]] = row
    return found


def sizes_table() -> str:
    """Return bits per sample of each codec and the ratios that the project aims at."""
    lines = [
        "| raster | bound, m | terrainwave | best of SPERR, SZ3 | COG LERC_ZSTD, overviews |"
        " largest error, m |",
        "|---|---|---|---|---|---|",
    ]
    to_peer, to_cog = [], []
    for (raster, bound), by_codec in cases(read_rows("cdf97")).items():
        ours = by_codec[OURS]
        peers = {name: row for name, row in by_codec.items() if name.startswith(("sperr", "sz3"))}
        best = min(peers, key=lambda name: float(peers[name]["bits_per_sample"]))
        bits = [
            float(row["bits_per_sample"]) for row in (ours, peers[best], by_codec["cog-overviews"])
        ]
        to_peer.append(bits[0] / bits[1])
        to_cog.append(bits[0] / bits[2])
        lines.append(
            f"| {raster} | {float(bound):g} | **{bits[0]:.3f}** | {bits[1]:.3f} ({best}) |"
            f" {bits[2]:.3f} |"
            f" {float(ours['measured_error']):g} |"
        )
    lines.append(
        f"| geometric mean of ratios | | 1 | {1 / geometric_mean(to_peer):.2f} |"
        f" {1 / geometric_mean(to_cog):.2f} | |"
    )
    return "\n".join(lines)


def speeds_table() -> str:
    """Return one-thread speeds of terrainwave beside those of the same run's peers."""
    lines = [
        "| raster | bound, m | encode, Msamples/s | SPERR | SZ3 | decode, Msamples/s | SPERR |"
        " SZ3 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (raster, bound), by_codec in cases(read_rows("cdf97")).items():
        encode = [float(by_codec[name]["encode_speed"]) for name in (OURS, "sperr", "sz3")]
        decode = [float(by_codec[name]["decode_speed"]) for name in (OURS, "sperr", "sz3")]
        numbers = " | ".join(f"{speed:.1f}" for speed in (*encode, *decode))
        lines.append(f"| {raster} | {float(bound):g} | {numbers} |")
    return "\n".join(lines)


TABLES: dict[str, Callable[[], str]] = {"sizes": sizes_table, "speeds": speeds_table}
_SLOT = re.compile(r"<!-- table: (\w+) -->\n.*?<!-- end -->", re.DOTALL)


def fill_in(text: str) -> str:
    """Return a document with every table made anew."""

    def make(slot: re.Match[str]) -> str:
        return f"<!-- table: {slot[1]} -->\n{TABLES[slot[1]]()}\n<!-- end -->"

    return _SLOT.sub(make, text)


def main() -> int:
    """Fill in or check the tables; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="change nothing; exit 1 if a table is old"
    )
    check = parser.parse_args().check
    status = 0
    for path in (ROOT / name for name in DOCUMENTS):
        if not path.exists():
            continue
        text = path.read_text(encoding="utf-8")
        new = fill_in(text)
        if new != text and check:
            print(f"{path.name}: a table is not what its CSV says", file=sys.stderr)
            status = 1
        elif new != text:
            path.write_text(new, encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main())
