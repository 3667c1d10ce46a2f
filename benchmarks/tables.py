"""Write the measured tables into documents: ``python -m benchmarks.tables``.

Each table stands between ``<!-- table: NAME -->`` and ``<!-- end -->`` in a document and is made
from a CSV under ``benchmarks/results``. ``--check`` changes nothing and exits 1 if a document does
not say what its CSV says.
"""

import argparse
import csv
import json
import math
import re
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
DOCUMENTS = (
    "README.md",
    "docs/benchmarks.md",
    "docs/integrations.md",
    "docs/systems.md",
    "docs/viewing.md",
    "docs/decisions/0004-step-by-what-finer-levels-need.md",
    "docs/decisions/0007-one-root-block.md",
    "docs/decisions/0009-tiles-of-several-levels.md",
    "docs/decisions/0010-order-of-payloads.md",
)
PREDICTIVE = "terrainwave-predictive"
FAST = "terrainwave-predictive-fast"
CDF97 = "terrainwave-cdf97"
OUR_CODECS = (PREDICTIVE, FAST, "terrainwave-predictive-best", CDF97)

Rows = list[dict[str, str]]


def read_rows(results: Path, name: str) -> Rows:
    """Return the rows of ``NAME.csv`` among the results; none if there is no such file."""
    path = results / f"{name}.csv"
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def geometric_mean(values: list[float]) -> float:
    """Return the geometric mean of positive numbers."""
    return math.exp(math.fsum(map(math.log, values)) / len(values))


class Case(NamedTuple):
    """Bits per sample of all codecs at one bound; `peers` without COG."""

    raster: str
    bound: float
    ours: dict[str, float]
    peers: dict[str, float]
    cog: float

    @property
    def best_peer(self) -> str:
        """Return the name of the smallest peer."""
        return min(self.peers, key=lambda name: self.peers[name])

    @property
    def best(self) -> float:
        """Return the bits of the smallest peer."""
        return self.peers[self.best_peer]


def read_all(results: Path) -> list[Case]:
    """Return the cases that the default method and the peers have been measured on.

    Bounds below 1 are for floats only: on whole metres they are lossless once more.
    """
    found: dict[tuple[str, float], dict[str, float]] = {}
    for name in ("predictive", "cdf97", "peers"):
        for row in read_rows(results, name):
            bound = float(row["max_error"])
            is_twice = row["dtype"].startswith("int") and 0 < bound < 1
            if row["bits_per_sample"] and not row["problem"] and not is_twice:
                by_codec = found.setdefault((row["raster"], bound), {})
                by_codec.setdefault(row["codec"], float(row["bits_per_sample"]))
    cases = []
    for (raster, bound), bits in sorted(found.items()):
        ours = {name: value for name, value in bits.items() if name.startswith("terrainwave")}
        peers = {name: value for name, value in bits.items() if name not in ours}
        cog = peers.pop("cog-overviews", math.nan)
        if PREDICTIVE in ours and peers:
            cases.append(Case(raster, bound, ours, peers, cog))
    return cases


def cases_table(results: Path) -> str:
    """Return every case: all of ours beside the best peer."""
    lines = [
        "| raster | bound, m | predictive | fast | best | cdf97 | best peer | predictive / peer |"
        " COG LERC_ZSTD, overviews |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for case in read_all(results):
        ours = " | ".join(
            f"{case.ours[name]:.3f}" if name in case.ours else "–" for name in OUR_CODECS
        )
        ratio = case.ours[PREDICTIVE] / case.best
        lines.append(
            f"| {case.raster} | {case.bound:g} | {ours} | {case.best:.3f} ({case.best_peer}) |"
            f" {ratio:.3f} | {case.cog:.3f} |"
        )
    return "\n".join(lines)


def _groups(cases: list[Case]) -> dict[str, list[Case]]:
    return {
        "all cases": cases,
        "lossless": [case for case in cases if case.bound == 0],
        "best peer below 1 bit/sample": [case for case in cases if case.best < 1],
    }


def summary_table(results: Path) -> str:
    """Return geometric means of size / best peer of the default over groups of cases."""
    lines = [
        "| cases | number | size / best peer, geometric mean | largest | size / COG LERC_ZSTD |",
        "|---|---|---|---|---|",
    ]
    for name, group in _groups(read_all(results)).items():
        if not group:
            continue
        ratios = [case.ours[PREDICTIVE] / case.best for case in group]
        to_cog = [case.ours[PREDICTIVE] / case.cog for case in group]
        lines.append(
            f"| {name} | {len(group)} | {geometric_mean(ratios):.3f} | {max(ratios):.3f} |"
            f" {geometric_mean(to_cog):.3f} |"
        )
    return "\n".join(lines)


def methods_table(results: Path) -> str:
    """Return the same means for each of our methods and efforts."""
    cases = read_all(results)
    groups = _groups(cases)
    lines = [
        "| size / best peer, geometric mean | " + " | ".join(groups) + " | measured on |",
        "|---" * (len(groups) + 2) + "|",
    ]
    for codec in OUR_CODECS:
        if not any(codec in case.ours for case in cases):
            continue
        cells = []
        for group in groups.values():
            ratios = [case.ours[codec] / case.best for case in group if codec in case.ours]
            cells.append(f"{geometric_mean(ratios):.3f}" if ratios else "–")
        number = sum(codec in case.ours for case in cases)
        lines.append(f"| {codec} | {' | '.join(cells)} | {number} of {len(cases)} cases |")
    return "\n".join(lines)


def speeds_table(results: Path) -> str:
    """Return speeds on one core beside SPERR's, with geometric means."""
    by_case: dict[tuple[str, float], dict[str, dict[str, str]]] = {}
    for row in read_rows(results, "speeds"):
        by_case.setdefault((row["raster"], float(row["max_error"])), {})[row["codec"]] = row
    codecs = (FAST, PREDICTIVE, CDF97, "sperr")
    names = ("fast", "predictive", "cdf97", "SPERR")
    lines = [
        "| raster | bound, m | "
        + " | ".join(f"{what} {name}" for what in ("encode", "decode") for name in names)
        + " |",
        "|---" * (2 + 2 * len(names)) + "|",
    ]
    columns: list[list[float]] = [[] for _ in range(2 * len(names))]
    for (raster, bound), rows in sorted(by_case.items()):
        if any(codec not in rows for codec in codecs):
            continue
        speeds = [
            float(rows[codec][f"{what}_speed"]) for what in ("encode", "decode") for codec in codecs
        ]
        for column, speed in zip(columns, speeds, strict=True):
            column.append(speed)
        cells = " | ".join(f"{speed:.1f}" for speed in speeds)
        lines.append(f"| {raster} | {bound:g} | {cells} |")
    if columns[0]:
        means = [geometric_mean(column) for column in columns]
        lines.append(
            "| geometric mean, Msamples/s | | " + " | ".join(f"{m:.1f}" for m in means) + " |"
        )
        sperr = len(names) - 1
        ratios = [mean / means[sperr if i <= sperr else -1] for i, mean in enumerate(means)]
        lines.append("| / SPERR | | " + " | ".join(f"{ratio:.2f}" for ratio in ratios) + " |")
    return "\n".join(lines)


def roots_table(results: Path, name: str = "roots") -> str:
    """Return by how many percent files with more root blocks are larger."""
    by_case: dict[tuple[str, float], dict[str, str]] = {}
    for row in read_rows(results, name):
        case = by_case.setdefault((row["raster"], float(row["max_error"])), {})
        is_first = row["roots_per_side"] == "1"
        case[row["roots_per_side"]] = row["bits_per_sample" if is_first else "change_percent"]
    lines = [
        "| raster | bound, m | one root, bits/sample | 2 × 2 | 4 × 4 |",
        "|---|---|---|---|---|",
    ]
    for (raster, bound), case in by_case.items():
        changes = " | ".join(f"{float(case[n]):+.1f} %" for n in ("2", "4"))
        lines.append(f"| {raster} | {bound:g} | {float(case['1']):.4f} | {changes} |")
    return "\n".join(lines)


def embedded_table(results: Path) -> str:
    """Return lossless sizes of `cdf53` and of JPEG 2000's 5/3."""
    cases: dict[str, dict[str, str]] = {}
    for row in read_rows(results, "embedded"):
        if not row["rate"]:
            name = f"{row['raster']}, {row['n_rows']} × {row['n_cols']}"
            cases.setdefault(name, {})[row["codec"]] = row["bits_per_sample"]
    lines = ["| raster | cdf53, bits/sample | OpenJPEG 5/3 | ratio |", "|---|---|---|---|"]
    for name, case in cases.items():
        ours, peer = float(case["terrainwave-cdf53"]), float(case["openjpeg-5/3"])
        lines.append(f"| {name} | {ours:.3f} | {peer:.3f} | {ours / peer:.3f} |")
    return "\n".join(lines)


def truncation_table(results: Path) -> str:
    """Return decibels of streams cut to so many bits per sample."""
    cases: dict[tuple[str, str], dict[str, str]] = {}
    for row in read_rows(results, "embedded"):
        if row["rate"]:
            name = f"{row['raster']}, {row['n_rows']} × {row['n_cols']}"
            cases.setdefault((name, row["rate"]), {})[row["codec"]] = row["psnr"] or "∞"
    lines = [
        "| raster | bits/sample | cdf53, dB | OpenJPEG 5/3 | difference | OpenJPEG 9/7 |",
        "|---|---|---|---|---|---|",
    ]
    for (name, rate), case in cases.items():
        ours, peer = case["terrainwave-cdf53"], case["openjpeg-5/3"]
        difference = float(ours.replace("∞", "inf")) - float(peer.replace("∞", "inf"))
        lines.append(
            f"| {name} | {rate} | {ours} | {peer} | {difference:+.2f} | {case['openjpeg-9/7']} |"
        )
    return "\n".join(lines)


def spiht_table(results: Path) -> str:
    """Return what adaptive models save of SPIHT's raw bits."""
    lines = ["| raster | raw, bits/sample | coded | change |", "|---|---|---|---|"]
    for row in read_rows(results, "spiht_bits"):
        raw, coded = float(row["raw_bits"]), float(row["coded_bits"])
        lines.append(
            f"| {row['raster']} | {raw:.3f} | {coded:.3f} | {100 * (coded / raw - 1):+.1f} % |"
        )
    return "\n".join(lines)


def pyramid_table(results: Path) -> str:
    """Return what the closed pyramid and three rings cost `cdf97`."""
    lines = [
        "| raster | bound, m | one level | pyramid | cost | three rings | cost |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['raster']} | {float(row['max_error']):g} | {row['one_level']} | {row['pyramid']} |"
        f" {row['cost_of_pyramid_percent']} % | {row['pyramid_rings_3']} |"
        f" {row['cost_of_rings_3_percent']} % |"
        for row in read_rows(results, "pyramid")
    ]
    return "\n".join(lines)


def meshes_table(results: Path) -> str:
    """Return triangles of meshes beside greedy Delaunay's, on lossless heights."""
    lines = [
        "| raster | error, m | pydelatin | halves | / pydelatin | one sweep of collapses |"
        " / pydelatin | share of angles below 5°, swept |",
        "|---|---|---|---|---|---|---|---|",
    ]
    rows = read_rows(results, "meshes")
    lines += [
        f"| {row['raster']} | {float(row['error']):g} | {int(row['delatin']):,} |"
        f" {int(row['halves']):,} | {float(row['ratio']):.3f} | {int(row['optimised']):,} |"
        f" {float(row['optimised_ratio']):.3f} | {float(row['optimised_share_below_5']):.2%} |"
        for row in rows
    ]
    if rows:
        means = [
            geometric_mean([float(row[name]) for row in rows])
            for name in ("ratio", "optimised_ratio")
        ]
        lines.append(f"| geometric mean | | | | {means[0]:.3f} | | {means[1]:.3f} | |")
    return "\n".join(lines)


def mesh_speeds_table(results: Path) -> str:
    """Return how fast meshes are derived."""
    lines = [
        "| raster | error, m | halves, Msamples/s | with a sweep, Msamples/s |",
        "|---|---|---|---|",
    ]
    rows = read_rows(results, "meshes")
    lines += [
        f"| {row['raster']} | {float(row['error']):g} | {row['halves_speed']} |"
        f" {row['optimised_speed']} |"
        for row in rows
    ]
    lines += [
        f"| {row['raster']}, {row['size']}², {row['threads']} threads, decoding included |"
        f" {float(row['error']):g} | {'' if sweep else row['seconds'] + ' s'} |"
        f" {row['seconds'] + ' s' if sweep else ''} |"
        for row in read_rows(results, "meshes_large")
        for sweep in (int(row["sweeps"]),)
    ]
    return "\n".join(lines)


def zerotree_table(results: Path) -> str:
    """Return Y10's scheme and the restricted quadtree beside greedy Delaunay."""
    lines = [
        "| raster | error, m | zerotree / pydelatin | its labels, bits/sample | rqt / pydelatin |"
        " rqt by detail: true error, m |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['raster']} | {float(row['error']):g} | {row['zerotree_ratio']} |"
        f" {row['zerotree_bits']} | {row['rqt_ratio']} | {row['rqt_by_detail_error']} |"
        for row in read_rows(results, "zerotree_mesh")
    ]
    return "\n".join(lines)


def leave_one_out_table(results: Path) -> str:
    """Sizes with tables that never saw the raster, relative to others: means over its bounds."""
    ratios: dict[str, dict[str, list[float]]] = {}
    for row in read_rows(results, "leave_one_out"):
        mine = ratios.setdefault(row["raster"], {"all": [], "in_use": [], "untrained": []})
        for name, found in mine.items():
            found.append(int(row["left_out_bytes"]) / int(row[f"{name}_bytes"]))
    lines = [
        "| raster | left out / trained on all | left out / in use | left out / untrained |",
        "|---|---|---|---|",
    ]
    means: dict[str, list[float]] = {"all": [], "in_use": [], "untrained": []}
    for raster, found_by_name in sorted(ratios.items()):
        for name, found in found_by_name.items():
            means[name].append(geometric_mean(found))
        lines.append(f"| {raster} | " + " | ".join(f"{m[-1]:.3f}" for m in means.values()) + " |")
    if ratios:
        whole = " | ".join(f"{geometric_mean(found):.3f}" for found in means.values())
        lines.append(f"| geometric mean | {whole} |")
    return "\n".join(lines)


def integrations_table(results: Path) -> str:
    """Return processor time through other libraries as a share of terrainwave's own."""
    lines = [
        "| raster | samples | bound | what | terrainwave, ms | through the library, ms | ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['raster']} | {row['n_rows']} × {row['n_cols']} | {float(row['max_error']):g} |"
        f" {row['what']} | {row['direct_ms']} | {row['through_ms']} | {row['ratio']} |"
        for row in read_rows(results, "integrations")
    ]
    return "\n".join(lines)


def render_table(results: Path) -> str:
    """Return frames, CPU times and triangles of the viewer by mode; GPU times by the renderer."""
    lines = [
        "| what | samples | mode | blocks of | frames | CPU per frame, ms: median | 99 % |"
        " paging | selecting | submitting | stalls | frames/s: median | 1 % low |"
        " triangles, median | blocks, median | read, MiB | GPU memory, MiB |",
        "|" + 17 * "---|",
    ]
    rows = read_rows(results, "render")
    for row in rows:
        has_cpu = float(row["p99_cpu"]) > 0
        names = ("median_cpu", "p99_cpu", "median_page", "median_select", "median_submit")
        cpu = [f"{float(row[name]):.2f}" if has_cpu else "–" for name in names]
        is_drawn = "CPU" not in row["what"]
        rates = [
            f"{1000 / float(row[name]):.3g}" if is_drawn else "–"
            for name in ("median_frame", "p99_frame")
        ]
        lines.append(
            f"| {row['what']} | {row['size']}² | {row['mode']} | {row['block']} | {row['frames']} |"
            f" {' | '.join(cpu)} | {row['stalls']} | {' | '.join(rates)} |"
            f" {float(row['median_triangles']):,.0f} | {float(row['median_blocks']):.0f} |"
            f" {float(row['read_mib']):.1f} | {float(row['gpu_mib']):.0f} |"
        )
    renderers = sorted({row["renderer"] for row in rows})
    return "\n".join([*lines, "", f"Renderer: {', '.join(renderers)}."])


def systems_grid_table(results: Path) -> str:
    """Return the grid of Yusov & Turlapov 2010 on one of our rasters."""
    lines = [
        "| block | bound, m | border rings | RMSE, m | heights, bits/sample | labels | total |"
        " triangles | regular blocks / these |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['block']} | {float(row['max_error']):g} | {row['rings']} |"
        f" {float(row['rmse']):.3f} | {float(row['heights_bits']):.3f} |"
        f" {float(row['labels_bits']):.3f} | {float(row['total_bits']):.3f} |"
        f" {int(row['triangles']):,} | {int(row['regular']) / int(row['triangles']):.2f} |"
        for row in read_rows(results, "systems")
    ]
    return "\n".join(lines)


def systems_methods_table(results: Path) -> str:
    """Return all methods on the same raster at the same bounds."""
    lines = [
        "| method | goal | bits/sample | RMSE, m | largest error, m |",
        "|---|---|---|---|---|",
    ]
    for row in read_rows(results, "systems_methods"):
        bound = f"{float(row['max_error']):g} m"
        goal = bound if row["goal"] == "max_error" else f"size of predictive at {bound}"
        lines.append(
            f"| {row['method']} | {goal} | {float(row['bits_per_sample']):.3f} |"
            f" {float(row['rmse']):.3f} | {float(row['measured_error']):g} |"
        )
    return "\n".join(lines)


def systems_modes_table(results: Path) -> str:
    """Return all modes of the viewer from the same cameras at one error on screen."""
    lines = [
        "| camera | mode | triangles | given to the GPU | CPU per frame, ms | frame, ms |"
        " uploaded for the first picture, kB | per frame, kB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    rows = read_rows(results, "systems_modes")
    for row in rows:
        cpu = f"{float(row['cpu_ms']):.2f}" if row["cpu_ms"] else "–"
        per_frame = f"{int(row['frame_bytes']) / 1e3:,.1f}" if row["frame_bytes"] else "–"
        lines.append(
            f"| {row['camera']} | {row['mode']} | {int(row['triangles']):,} |"
            f" {int(row['submitted']):,} | {cpu} | {float(row['frame_ms']):,.0f} |"
            f" {int(row['first_bytes']) / 1e3:,.0f} | {per_frame} |"
        )
    renderers = sorted({row["renderer"] for row in rows})
    taus = " and ".join(sorted({f"{float(row['tau']):g}" for row in rows}))
    return "\n".join([*lines, "", f"Renderer: {', '.join(renderers)}. τ kept: {taus} pixels."])


def systems_dynamic_table(results: Path) -> str:
    """Return dynamic against rqt at one threshold."""
    found: dict[tuple[str, float], dict[str, dict[str, str]]] = {}
    for row in read_rows(results, "dynamic"):
        if row["side"] == "512" and row["view"] == "down":
            found.setdefault((row["error"], float(row["tau"])), {})[row["system"]] = row
    lines = [
        "| errors | τ, pixels | triangles: dynamic | rqt | dynamic / rqt |"
        " largest distance on screen, pixels: dynamic | rqt | update, ms: dynamic | rqt |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for (error, tau), systems in sorted(found.items()):
        one, two = systems["dynamic"], systems["rqt"]
        cells = [f"{int(one['triangles']):,}", f"{int(two['triangles']):,}"]
        cells.append(f"{int(one['triangles']) / int(two['triangles']):.2f}")
        cells += [
            f"{float(row[name]):.2f}" for name in ("largest_pixels", "median_ms")
            for row in (one, two)
        ]  # fmt: skip
        lines.append(f"| {error} | {tau:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def systems_papers_table(results: Path) -> str:
    """Return the papers' figures beside ours."""
    lines = ["| source | what | paper | ours | what differs |", "|---|---|---|---|---|"]
    lines += [
        "| " + " | ".join(row[name] for name in ("source", "what", "paper", "ours", "differs"))
        + " |"
        for row in read_rows(results, "systems_papers")
    ]  # fmt: skip
    return "\n".join(lines)


def remote_table(results: Path) -> str:
    """Return what windows over http cost: medians and worst cases."""
    lines = [
        "| reader | level | window | windows | requests: centre | median | worst | rounds |"
        " bytes / needed: median | worst |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    cases: dict[tuple[str, ...], dict[str, dict[str, str]]] = {}
    for row in read_rows(results, "remote"):
        case = row["reader"], row["level"], row["window"], row["n_windows"]
        cases.setdefault(case, {})[row["statistic"]] = row
    for (reader, level, side, n_windows), found in cases.items():
        counts = [f"{float(found[name]['requests']):g}" for name in ("centre", "median", "worst")]
        ratios = [f"{float(found[name]['ratio']):.2f}" for name in ("median", "worst")]
        cells = [reader, level.replace("-", "−"), f"{side}²", n_windows, *counts]
        cells += [f"{float(found['worst']['rounds']):g}", *ratios]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


TABLES: dict[str, Callable[[Path], str]] = {
    "summary": summary_table,
    "methods": methods_table,
    "cases": cases_table,
    "speeds": speeds_table,
    "roots": roots_table,
    "roots_cdf97": partial(roots_table, name="roots_cdf97"),
    "embedded": embedded_table,
    "truncation": truncation_table,
    "spiht_bits": spiht_table,
    "pyramid": pyramid_table,
    "meshes": meshes_table,
    "render": render_table,
    "mesh_speeds": mesh_speeds_table,
    "zerotree_mesh": zerotree_table,
    "leave_one_out": leave_one_out_table,
    "integrations": integrations_table,
    "systems_grid": systems_grid_table,
    "systems_methods": systems_methods_table,
    "systems_modes": systems_modes_table,
    "systems_dynamic": systems_dynamic_table,
    "systems_papers": systems_papers_table,
    "remote": remote_table,
}
REPORT = """# Measured

Bits per sample of whole files at equal guaranteed error, written by `make bench`; the CSVs beside
this file hold every figure, the JSONs machine, versions and commit of each.

{machine}

## Size against the best peer of each case

{summary}

{methods}

## Speeds, Msamples/s of processor time on one core

Rasters of a million samples or more, at bounds where predictive takes at most 1 bit/sample.

{speeds}

## All cases, bits per sample

{cases}

![bits per sample against the bound](rates.png)
"""
_SLOT = re.compile(r"<!-- table: (\w+) -->\n.*?<!-- end -->", re.DOTALL)


def fill_in(text: str) -> str:
    """Return a document with every table made anew."""

    def make(slot: re.Match[str]) -> str:
        return f"<!-- table: {slot[1]} -->\n{TABLES[slot[1]](RESULTS)}\n<!-- end -->"

    return _SLOT.sub(make, text)


def describe(results: Path) -> str:
    """Return one line on the machine of each CSV."""
    lines = []
    for name in ("predictive", "cdf97", "peers", "speeds"):
        path = results / f"{name}.json"
        if path.exists():
            machine = json.loads(path.read_text(encoding="utf-8"))
            versions = ", ".join(
                f"{package} {version}" for package, version in machine["packages"].items()
            )
            lines.append(
                f"* `{name}.csv`: {machine['processor']}, {machine['n_cores']} cores,"
                f" {machine['system']}, Python {machine['python']}, GDAL {machine['gdal']},"
                f" {versions}; commit {machine['commit']}"
                + (", some rows by earlier runs" if "earlier" in machine else "")
            )
    return "\n".join(lines)


def write_all(results: Path) -> list[str]:
    """Write ``bench.md``, and the documents if these are the repository's results."""
    made = {name: make(results) for name, make in TABLES.items()}
    report = REPORT.format(machine=describe(results), **made)
    (results / "bench.md").write_text(report, encoding="utf-8")
    written = [str(results / "bench.md")]
    if results.resolve() == RESULTS:
        for path in documents():
            path.write_text(fill_in(path.read_text(encoding="utf-8")), encoding="utf-8")
            written.append(str(path.relative_to(ROOT)))
    return written


def documents() -> list[Path]:
    """Return the documents with tables."""
    return [ROOT / name for name in DOCUMENTS if (ROOT / name).exists()]


def main() -> int:
    """Fill in or check the tables; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="change nothing; exit 1 if a table is old"
    )
    check = parser.parse_args().check
    status = 0
    for path in documents():
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
