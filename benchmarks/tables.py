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
CDF97 = "terrainwave-cdf97"
PREDICTIVE = "terrainwave-predictive"

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


def compared() -> list[tuple[str, float, float, float, str, float]]:
    """Return (raster, bound, ours, best peer, its name, COG) in bits per sample for each case.

    Bounds below 1 are for floats only: on whole metres they are lossless once more.
    """
    peers = cases(read_rows("peers"))
    found = []
    for (raster, bound), by_codec in cases(read_rows("predictive")).items():
        row = by_codec[PREDICTIVE]
        if row["dtype"].startswith("int") and 0 < float(bound) < 1:
            continue
        others = {
            name: float(other["bits_per_sample"])
            for name, other in peers[raster, bound].items()
            if other["bits_per_sample"] and not other["problem"]
        }
        cog = others.pop("cog-overviews")
        best = min(others, key=lambda name: others[name])
        bits = float(row["bits_per_sample"])
        found.append((raster, float(bound), bits, others[best], best, cog))
    return found


def cases_table() -> str:
    """Return every case of the default method beside its best peer."""
    lines = [
        "| raster | bound, m | terrainwave | best peer | ratio | COG LERC_ZSTD, overviews |",
        "|---|---|---|---|---|---|",
    ]
    for raster, bound, bits, peer, name, cog in compared():
        lines.append(
            f"| {raster} | {bound:g} | {bits:.3f} | {peer:.3f} ({name}) | {bits / peer:.3f} |"
            f" {cog:.3f} |"
        )
    return "\n".join(lines)


def summary_table() -> str:
    """Return geometric means of size / best peer over groups of cases."""
    rows = compared()
    groups = {
        "all cases": rows,
        "lossless": [row for row in rows if row[1] == 0],
        "best peer below 1 bit/sample": [row for row in rows if row[3] < 1],
    }
    lines = [
        "| cases | number | size / best peer, geometric mean | largest | size / COG LERC_ZSTD |",
        "|---|---|---|---|---|",
    ]
    for name, group in groups.items():
        ratios = [row[2] / row[3] for row in group]
        to_cog = [row[2] / row[5] for row in group]
        lines.append(
            f"| {name} | {len(group)} | {geometric_mean(ratios):.3f} | {max(ratios):.3f} |"
            f" {geometric_mean(to_cog):.3f} |"
        )
    return "\n".join(lines)


def sizes_table() -> str:
    """Return bits per sample of each codec and the ratios that the project aims at."""
    lines = [
        "| raster | bound, m | terrainwave | best of SPERR, SZ3 | COG LERC_ZSTD, overviews |"
        " largest error, m |",
        "|---|---|---|---|---|---|",
    ]
    to_peer, to_cog = [], []
    for (raster, bound), by_codec in cases(read_rows("cdf97")).items():
        ours = by_codec[CDF97]
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
        encode = [float(by_codec[name]["encode_speed"]) for name in (CDF97, "sperr", "sz3")]
        decode = [float(by_codec[name]["decode_speed"]) for name in (CDF97, "sperr", "sz3")]
        numbers = " | ".join(f"{speed:.1f}" for speed in (*encode, *decode))
        lines.append(f"| {raster} | {float(bound):g} | {numbers} |")
    return "\n".join(lines)


TABLES: dict[str, Callable[[], str]] = {
    "summary": summary_table,
    "cases": cases_table,
    "sizes": sizes_table,
    "speeds": speeds_table,
}
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
