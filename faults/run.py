"""Kill, starve, cut off and crowd the package, and count what comes of it.

`kills`: commands killed with signal 9 while they write; `signals`: commands interrupted, those that
write nothing, too; `disk`: full disks; `network`: a server that fails, stalls or lies; `writers`:
two of one target; `readers`: forks and threads; `opens`: 10,000 of them. Each writes a CSV,
``faults_NAME.csv``; that of `signals` is gone on with. The exit status is 1 if one of them found a
fault.
"""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import click

from benchmarks.common import (
    COUNT,
    EXISTING,
    ListOption,
    command,
    option,
    read_rows,
    write_rows,
)
from faults import disk, kills, network, sharing, signals
from faults.commands import (
    Command,
    everything_on_disk,
    make_inputs,
    reading_commands,
    warm_up,
    writing_commands,
)

# Columns in which every number but 0 is a fault.
FAULTS = (
    "broken", "left_behind", "leftovers_after_next", "failed_next", "others_touched", "crashes",
    "hangs", "wrong", "others", "then_wrong", "failed", "errors",
)  # fmt: skip
PARTS = ("kills", "signals", "disk", "writers", "opens", "readers", "network")


@command("")
@option("--only", type=click.Choice(PARTS), cls=ListOption, default=PARTS)
@option("--dem", type=EXISTING, help="A raster whose corner is taken. Default: made-up hills.")
@option("--side", type=COUNT, default=400, help="Samples on a side.")
@option("--kills", "n_kills", type=COUNT, default=200, help="Of each command, by the clock.")
@option("--signals", "n_signals", type=COUNT, default=300, help="To each command.")
@option("--disks", "n_disks", type=COUNT, default=50, help="Sizes for each command.")
@option("--pairs", "n_pairs", type=COUNT, default=50, help="Of writers, for each command.")
@option("--forks", "n_forks", type=COUNT, default=100, help="Of each kind.")
@option("--opens", "n_opens", type=COUNT, default=10_000, help="A tenth as many over http.")
@option("--commands", cls=ListOption, help="These alone are killed or run on full disks.")
@option("--seed", type=int, default=0)
def main(
    out: Path, folder: Path, only: tuple[str, ...], dem: Path | None, side: int, n_kills: int,
    n_signals: int, n_disks: int, n_pairs: int, n_forks: int, n_opens: int,
    commands: tuple[str, ...], seed: int,
) -> None:  # fmt: skip
    """Run the trials."""
    everything_on_disk()
    inputs = folder / "inputs"
    inputs.mkdir(exist_ok=True)
    make_inputs(inputs, dem, side)

    def selected(those: list[Command]) -> list[Command]:
        return [one for one in those if one.name in (commands or (one.name,))]

    chosen = selected(writing_commands(inputs))
    warm_up(chosen, inputs)
    reading = selected(reading_commands(inputs)) if "signals" in only else []
    warm_up(reading, inputs)
    exact, other = inputs / "exact.twz", inputs / "other.twz"
    written: list[Any] = []

    def write(name: str, rows: Iterable[Any], *, append: bool = False) -> None:
        written.extend(write_rows(out / f"faults_{name}.csv", rows, append=append))

    if "kills" in only:
        write("kills", kills.rows(chosen, folder, n_kills, seed))
    if "signals" in only:
        known = {row["command"] for row in read_rows(out / "faults_signals.csv")}
        left = [one for one in chosen + reading if one.name not in known]
        write("signals", signals.rows(left, folder, n_signals, seed), append=True)
    if "disk" in only:
        write("disk", disk.rows(chosen, folder, n_disks, seed))
    if "writers" in only:
        write("writers", sharing.writers(chosen, folder, n_pairs, seed))
    if "opens" in only:
        write("opens", sharing.opens(exact, n_opens // 2, n_opens // 20))
    if "readers" in only:
        readers = [sharing.forks(exact, n_forks, 10), sharing.threads(exact, 100)]
        write("readers", chain.from_iterable(readers))
    if "network" in only:
        write("network", network.rows(exact, other))
    raise SystemExit(any(n_faults(row) for row in written))


def n_faults(row: Any) -> int:
    """Return how many faults a trial has found; a second writer that is refused is none."""
    names = [name for name in FAULTS if name != "failed" or not isinstance(row, sharing.Writers)]
    return sum(getattr(row, name, 0) for name in names)


if __name__ == "__main__":
    main()
