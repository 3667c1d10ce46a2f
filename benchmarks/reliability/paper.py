"""Put 10^12 samples on paper: ``python -m benchmarks.reliability.paper``.

Takes ``scale_commands.csv``, whose largest raster is scaled to 10^6 x 10^6 samples, and
``scaling_extrapolated.csv`` for a cluster. What follows from the format is counted. Processor time
is taken to grow with samples, and the memory of ``compress`` with coded units, at the rate between
16384² and the largest raster.

Exit status: 0 good; 1 there is nothing measured; 2 wrong usage.
"""

import math
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks import common
from terrainwave.container.header import MAX_PAGE
from terrainwave.container.page import MAX_PAYLOAD, page_layout
from terrainwave.grid.quadtree import Block, Grid

LARGE = 10**6  # samples on a side
BLOCK = 256
SMALLER = 16384
CORES = 100
PREFIX = 12  # of a page, before its columns

# One line of the CSV: at the largest raster measured, at LARGE, and where it ends.
Row = namedtuple("Row", "what unit measured paper limit")


def n_segments(grid: Grid) -> int:
    """Return the number of segments: the top one, and one for each head."""
    return 1 + sum(math.prod(grid.level_blocks(level)) for level in grid.segment_levels())


def largest_page(grid: Grid) -> int:
    """Return the bytes of the fullest page if nothing of it deflates."""
    head = Block(grid.segment_levels()[-2], 0, 0) if len(grid.segment_levels()) > 1 else None
    keys, blocks, children = map(len, page_layout(grid, head))
    return min(MAX_PAGE, PREFIX + 17 * keys + 4 * blocks + 12 * children)


def counted(side: int) -> dict[str, float]:
    """Return what follows from the format for a square raster."""
    grid = Grid(side, side, BLOCK)
    index = n_segments(grid) * largest_page(grid)
    return {
        "samples": side**2, "levels": grid.k_max + 1, "units": grid.n_units(),
        "segments": n_segments(grid), "index": index / 1e6,
        # Levels above the full grid, int32 each: a third of the samples.
        "temporary": side**2 / 3 * 4 / 1e9,
    }  # fmt: skip


def rows_of(rows: list[dict[str, Any]], cluster: dict[str, Any]) -> Iterator[Row]:
    """Yield the lines of the CSV."""
    side = max(row["size"] for row in rows)
    found = {(row["size"], row["stage"]): row for row in rows}
    here, there = counted(side), counted(LARGE)
    scale = there["samples"] / here["samples"]
    file_gb = found[side, "compress"]["n_bytes"] / 1e9
    yield Row("samples", "", here["samples"], there["samples"], "2^50")
    yield Row("levels", "", here["levels"], there["levels"], "27")
    yield Row("units", "", here["units"], there["units"], "none but memory")
    yield Row("segments", "", here["segments"], there["segments"], "none but memory")
    yield Row("file and its largest offset", "GB", file_gb, file_gb * scale, "2^63 bytes")
    yield Row("index, at most", "MB", here["index"], there["index"], f"{MAX_PAGE} bytes a page")
    payload = file_gb * 1e9 / here["units"]
    yield Row("mean payload", "bytes", payload, payload, f"{MAX_PAYLOAD} bytes")
    for stage in ("compress", "verify", "read"):
        large = found[side, stage]
        hours = large["net_per_million"] * there["samples"] / 1e6 / 3600
        yield Row(
            f"{stage}: processor time", "hours", large["cpu_seconds"] / 3600, hours,
            f"{hours / CORES:.2g} hours of {CORES} cores, if all is shared",
        )  # fmt: skip
    large, small = found[side, "compress"], found[SMALLER, "compress"]
    per_unit = large["peak_mib"] - small["peak_mib"]
    per_unit /= here["units"] - counted(SMALLER)["units"]
    yield Row(
        "compress: memory", "MiB", large["peak_mib"],
        large["peak_mib"] + per_unit * (there["units"] - here["units"]),
        f"the machine's; {per_unit * 2**20:,.0f} bytes a unit",
    )  # fmt: skip
    yield Row(
        "temporary files without voids", "GB", here["temporary"] + file_gb,
        there["temporary"] + file_gb * scale, "the disk",
    )  # fmt: skip
    yield Row(
        "on a cluster: the client's processor time", "hours", math.nan, cluster["hours_here"],
        "one process",
    )  # fmt: skip
    yield Row("on a cluster: the depot", "GB", math.nan, cluster["depot_gb"], "shared storage")


@common.command("scale_paper.csv")
def main(folder: Path, out: Path) -> None:
    """Write the CSV."""
    rows = common.read_rows(common.RESULTS / "scale_commands.csv")
    cluster = common.read_rows(common.RESULTS / "scaling_extrapolated.csv")
    if not (rows and cluster):
        raise SystemExit("run benchmarks.reliability.scale and benchmarks.scaling before")
    common.write_rows(out, rows_of(rows, cluster[0]))


if __name__ == "__main__":
    main()
