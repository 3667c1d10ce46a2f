"""Seconds until a published page shows its terrain: ``python -m benchmarks.first_picture DEM …``.

Chromium, with an empty cache, opens the folder that `terrainwave publish` makes, through a server
of 50 ms and 20 Mbit/s. The clock runs from the request for the page until a picture of the terrain
is seen (the still, if the page has one) and until all of the first view is drawn (the page's state
is "complete"). WebGL runs on the processor, and so does the server.
``--package`` measures the page of another checkout beside this one, in turns.
"""

import os
import statistics
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from benchmarks import common
from benchmarks.slow_server import SlowServer

sys.path.insert(0, str(common.ROOT / "tests"))

# Medians; the fastest and the slowest run. `paint_seconds`: until anything is seen;
# `picture_seconds`: until the terrain is.
Row = namedtuple(
    "Row",
    "raster page file_bytes latency_ms mbit_per_second n_requests n_bytes paint_seconds "
    "picture_seconds seconds least_seconds most_seconds n_runs",
)
# Tells when the page first had each state.
WATCH = """
    globalThis.states = {};
    new MutationObserver(() => {
      const state = document.body?.dataset.state;
      if (state) globalThis.states[state] ??= performance.now();
      if (document.getElementById("still") && !("still" in globalThis.states)) {
        globalThis.states.still = Infinity; // until the frame after the next one begins
        requestAnimationFrame(() => requestAnimationFrame(() => {
          globalThis.states.still = performance.now();
        }));
      }
    }).observe(document, { subtree: true, childList: true, attributes: true });
"""
TOLD = """
    const paint = performance.getEntriesByName("first-contentful-paint")[0];
    const { still = Infinity, complete } = globalThis.states;
    return [paint.startTime, Math.min(still, complete), complete].map((time) => time / 1000);
"""
PATIENCE = 120


def run(source: Path, *arguments: str | Path) -> None:
    """Run a command of the package in a folder of sources."""
    environment = {**os.environ, "PYTHONPATH": str(source)}
    command = [sys.executable, "-c", common.CLI, *map(str, arguments), "--quiet"]
    subprocess.run(command, env=environment, check=True)


def first_picture(driver: Any, site: Path, latency: float, bits: float) -> tuple[float, ...]:
    """Return requests, bytes, and the seconds until something, the terrain and all is seen."""
    with SlowServer(site, latency, bits) as server:
        driver.get("about:blank")
        driver.execute_cdp_cmd("Network.clearBrowserCache", {})
        driver.get(server.url("index.html"))
        end = time.monotonic() + PATIENCE
        while (state := driver.execute_script("return document.body.dataset.state")) != "complete":
            if state == "failed" or time.monotonic() > end:
                told = driver.execute_script("return document.getElementById('message').innerText")
                raise SystemExit(f"{site}: the page is {state}, not complete: {told}")
            time.sleep(0.1)
        return server.n_requests, server.n_bytes, *driver.execute_script(TOLD)


def measure(paths, packages, latency_ms, mbit, n_runs, folder) -> Iterator[Row]:
    """Yield a row of each raster and page; the first run of each does not count."""
    from ext.browser import chromium

    with chromium() as driver:
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WATCH})
        for raster in paths:
            file = folder / f"{raster.stem}.twz"
            if not file.exists():
                run(next(iter(packages.values())), "compress", raster, file, "--max-error", "1")
            found: dict[str, list] = {}
            for name, source in packages.items():
                run(source, "publish", file, folder / f"{file.stem}-{name}", "--overwrite")
            for _ in range(n_runs + 1):
                for name in packages:
                    site = folder / f"{file.stem}-{name}"
                    one = first_picture(driver, site, latency_ms / 1000, 1e6 * mbit)
                    found.setdefault(name, []).append(one)
            for name, runs in found.items():
                columns = list(zip(*runs[1:], strict=True))
                n_requests, n_bytes, paint, picture, seconds = map(statistics.median, columns)
                yield Row(
                    raster.stem, name, file.stat().st_size, latency_ms, mbit, int(n_requests),
                    int(n_bytes), round(paint, 2), round(picture, 2), round(seconds, 2),
                    round(min(columns[4]), 2), round(max(columns[4]), 2), n_runs,
                )  # fmt: skip


@common.command("first_picture.csv")
@common.rasters_argument
@click.option("--package", "others", multiple=True, help="NAME=PATH of another one's src.")
@common.option("--latency-ms", type=click.IntRange(min=0), default=50)
@common.option("--mbit", type=click.FloatRange(min=0), default=20, help="0: a line without limit.")
@common.option("--runs", type=common.COUNT, default=5)
def main(paths, others, latency_ms, mbit, runs, folder, out) -> None:
    """Measure first pictures."""
    packages = {"now": common.ROOT / "src"}
    packages |= {name: Path(path) for name, path in (text.split("=", 1) for text in others)}
    common.write_rows(out, measure(paths, packages, latency_ms, mbit, runs, folder))


if __name__ == "__main__":
    main()
