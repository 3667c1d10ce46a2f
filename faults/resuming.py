"""Kill long runs with signal 9; the same command goes on: ``python -m faults.resuming dem.tif``.

The raster mirrors `dem.tif`. A run is killed, the next one goes on and is killed, and so on; after
`--chain` kills one may end, and its file is compared byte by byte with that of a run that nobody
disturbed. Writes a line for each kill, and to ``…_summary.csv`` one for each command.

*Finished* is what the run had done when it was killed, in processor seconds: of each stage the
share that its progress tells, times what the stage took undisturbed. *Kept* is what the journal has
of it. Exit status: 0 good; 1 other bytes, a failure, or less kept than `--least`; 2 wrong usage.
"""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import psutil
import rasterio

import terrainwave
from benchmarks import common
from benchmarks.rasters import make_mirrored
from terrainwave.container.targets.kept import Kept
from terrainwave.grid.quadtree import Grid
from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.temporary import MEMORY_LIMIT
from terrainwave.write.passes import resuming
from terrainwave.write.passes.proof import proof_shares
from terrainwave.write.pyramid import TILE

Row = namedtuple("Row", "command chain kill stage seconds finished_s kept_s lost_s kept_share")
Summary = namedtuple(
    "Summary",
    "command samples kills undisturbed_cpu_s chains same_bytes finished_s kept_share "
    "least_share_after_5_s largest_lost_s left_after threads",
)
# What earlier stages leave to later ones; `patching` stands for `encoding`.
STAGES = ("scanning", "making levels", "encoding", "proving")
_EARLY = 5.0  # seconds of finished work, of which a fraction of a second is more than a tenth


@common.command("faults_resumed.csv")
@common.dem_argument
@common.option("--side", type=common.COUNT, default=16_385, help="Samples on a side.")
@common.option("--kills", "n_kills", type=common.COUNT, default=50, help="Of each command.")
@common.option("--chain", "n_chain", type=common.COUNT, default=5, help="Kills of one file.")
@common.option("--commands", cls=common.ListOption, default=("compress", "patch"))
@common.option("--threads", type=common.COUNT, default=2)
@common.option("--least", type=click.FloatRange(0, 1), default=0.9, help="Share that is kept.")
@common.option("--seed", type=int, default=0)
def main(
    dem: Path, side: int, n_kills: int, n_chain: int, commands: tuple[str, ...], threads: int,
    least: float, seed: int, folder: Path, out: Path,
) -> None:  # fmt: skip
    """Run the trials."""
    raster, newer = folder / "large.tif", folder / "newer.tif"
    make_mirrored(dem, raster, side)
    make_newer(raster, newer)
    generator = random.Random(seed)
    rows: list[Row] = []
    summaries = []
    for command in commands:
        trial = Trial(command, folder, raster, newer, threads)
        own: list[Row] = []
        for row in trial.rows(n_kills, n_chain, generator):
            own.append(row)
            common.write_rows(out, [*rows, *own])
        rows += own
        summaries.append(trial.summary(own))
        common.write_rows(out.with_name(f"{out.stem}_summary.csv"), summaries)
    is_good = all(
        one.same_bytes == one.chains and one.kept_share >= least and not one.left_after
        for one in summaries
    )
    if not is_good:
        raise click.ClickException("other bytes, leftovers, or less kept than expected")


def make_newer(raster: Path, newer: Path) -> None:
    """Write the raster again with a hundredth of its area raised."""
    shutil.copy(raster, newer)
    with rasterio.open(newer, "r+") as dataset:
        side = dataset.width // 10
        window = rasterio.windows.Window(side, side, side, side)
        heights = dataset.read(1, window=window)
        dataset.write(np.where(heights == dataset.nodata, heights, heights + 3), 1, window=window)


class Trial:
    """One command, killed again and again."""

    def __init__(self, command: str, folder: Path, raster: Path, newer: Path, threads: int) -> None:
        self.command, self.threads = command, threads
        self.work = folder / command
        self.work.mkdir(exist_ok=True)
        self.target = self.work / "out.twz"
        self.log = folder / f"{command}.log"
        self.before = folder / "before.twz"
        if command == "patch":
            if not self.before.exists():
                terrainwave.compress(raster, self.before, max_error=1, overwrite=True)
            self.sources = [newer]
        else:
            self.sources = [raster]
        with RasterSource(raster) as source:
            self.grid = Grid(source.info.n_rows, source.info.n_cols, 256)
            self.n_windows = sum(1 for _ in source.blocks())
        self.restart()
        self.undisturbed()

    def restart(self) -> None:
        """Put the target back to what it is before the command."""
        self.target.unlink(missing_ok=True)
        if self.command == "patch":
            shutil.copy2(self.before, self.target)

    def start(self) -> subprocess.Popen:
        """Start the command."""
        self.log.unlink(missing_ok=True)
        arguments = [self.command, str(self.target), *map(str, self.sources), str(self.log)]
        return subprocess.Popen(
            [sys.executable, "-m", "faults.resuming_run", *arguments, str(self.threads)],
            cwd=common.ROOT,
        )

    def undisturbed(self) -> None:
        """Run it, and note processor seconds of its stages and the bytes of its file."""
        for _ in range(2):  # the first compiles
            self.restart()
            if self.start().wait():
                raise click.ClickException(f"{self.command} fails undisturbed")
        self.expected = digest(self.target)
        told = self.told()
        ends = {stage: cpu for stage, _, cpu in told}
        began = told[0][2]
        self.seconds: dict[str, float] = {}
        for stage in STAGES:
            if stage in ends:
                self.seconds[stage] = ends[stage] - began
                began = ends[stage]

    def told(self) -> list[tuple[str, float, float]]:
        """Return what a run has told of its progress: stage, share done, processor seconds."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return [tuple(json.loads(line)) for line in lines if line.endswith("]")]

    def rows(self, n_kills: int, n_chain: int, generator: random.Random) -> Iterator[Row]:
        """Kill it so often, a new file after every `n_chain`."""
        self.n_chains = self.n_same = 0
        for first in range(0, n_kills, n_chain):
            self.restart()
            number = min(n_chain, n_kills - first)
            total = sum(self.seconds.values())
            for kill in range(number):
                row = self.killed(2 * generator.random() * total / (number + 1))
                if row is None:  # it ended before
                    break
                yield row._replace(chain=self.n_chains, kill=kill)
            process = self.start()
            process.wait()
            self.n_chains += 1
            self.n_same += process.returncode == 0 and digest(self.target) == self.expected

    def killed(self, seconds: float) -> Row | None:
        """Kill a run so many processor seconds after its first progress; None if it ended."""
        process = self.start()
        while not self.told():
            time.sleep(0.01)
            if process.poll() is not None:
                return None
        own = psutil.Process(process.pid)
        until = self.told()[0][2] + seconds
        while sum(own.cpu_times()[:2]) < until and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        if process.wait() == 0 or not any(self.kept_directories()):
            return None  # killed when all was done: what was kept is gone
        told = self.told()
        kept = self.kept()
        finished = self.finished(told, kept)
        had, has = (
            sum(self.seconds.get(stage, 0) * share for stage, share in one.items())
            for one in (finished, kept)
        )
        share = min(has / had, 1.0) if had else 1.0
        return Row(
            self.command, 0, 0, told[-1][0], round(seconds, 2), round(had, 2), round(has, 2),
            round(max(had - has, 0.0), 2), round(share, 4),
        )  # fmt: skip

    def finished(
        self, told: list[tuple[str, float, float]], kept: dict[str, float]
    ) -> dict[str, float]:
        """Return the share of each stage that is done; of those before the last one all of it."""
        done = dict.fromkeys(STAGES[: STAGES.index(told[-1][0])], 1.0)
        for stage, share, _ in told:
            done[stage] = max(done.get(stage, 0.0), share)
        return {stage: max(share, kept.get(stage, 0.0)) for stage, share in done.items()}

    def kept_directories(self) -> list[Path]:
        """Return where finished work is kept."""
        return list(self.work.glob(".out.twz.*.twz-kept"))

    def kept(self) -> dict[str, float]:
        """Return the share of each stage that the next run finds."""
        (directory,) = self.kept_directories()
        copy = self.work.parent / "journal copy"
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir()
        shutil.copy(directory / "journal", copy)
        with open(directory / "journal", "rb") as file:
            run = first_values(file.read(1 << 20))
        kept = Kept(copy, run)
        name = "patch" if self.command == "patch" else "rapid"
        found = {"scanning": (kept.get("scan") or {}).get("done", 0) / self.n_windows}
        shifts = range(1, self.grid.k_max + 1)
        tiles = {
            shift: -(-(self.grid.n_rows >> shift) // TILE) * -(-(self.grid.n_cols >> shift) // TILE)
            for shift in shifts
        }
        done = sum((kept.get(f"nested-{shift}") or {}).get("done", 0) for shift in shifts)
        # Levels in memory are made again in no time.
        in_files = sum(
            tiles[shift] for shift in shifts if 4 * TILE**2 * tiles[shift] > MEMORY_LIMIT
        )
        found["making levels"] = min(done / in_files, 1.0)
        level = resuming.KeptUnits(kept, self.grid, name).level
        heads = self.grid.blocks(level)
        names = set(kept.names())
        n_units = sum(f"{name}/{level}/{row}/{col}" in names for _, row, col in heads)
        found["encoding"] = n_units / len(heads)
        proofs = [kept.get(name) or {} for name in names if name.startswith("proof/")]
        n_shares = len(proof_shares(self.grid))
        found["proving"] = max((one.get("done", 0) for one in proofs), default=0) / n_shares
        kept.close()
        return found

    def summary(self, rows: list[Row]) -> Summary:
        """Return a line for all kills."""
        had, has = sum(row.finished_s for row in rows), sum(row.kept_s for row in rows)
        late = [row.kept_share for row in rows if row.finished_s >= _EARLY]
        left = sum(name.startswith(".") for name in os.listdir(self.work))
        return Summary(
            self.command, self.grid.n_rows * self.grid.n_cols, len(rows),
            round(sum(self.seconds.values()), 1), self.n_chains, self.n_same, round(had, 1),
            round(has / had, 4), min(late, default=1.0), max(row.lost_s for row in rows), left,
            self.threads,
        )  # fmt: skip


def first_values(data: bytes) -> dict:
    """Return what the first record of a journal says."""
    text = data[data.index(b"{") :].decode(errors="replace")
    return json.JSONDecoder().raw_decode(text)[0]["values"]


def digest(path: Path) -> str:
    """Return a digest of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    main()
