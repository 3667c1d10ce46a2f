"""Fuzz targets for a while: ``python -m fuzz.run --seconds 60 [TARGET …]``.

Targets with kernels run twice, in a process of their own: a fifth of the time with kernels as plain
Python, which shows the fuzzer their branches, the rest with kernels compiled and bounds checked,
which is fast. What a run finds worth keeping stays in ``build/fuzz/TARGET``, finds go to
``build/fuzz/finds``, and a line for each target and mode to ``benchmarks/results/fuzz.csv``:
executions, seconds and finds are added to those of the runs before it.
"""

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import click

ROOT = Path(__file__).parents[1]
WORK = ROOT / "build" / "fuzz"
RESULTS = ROOT / "benchmarks" / "results" / "fuzz.csv"
FIELDS = ("target", "mode", "executions", "accepted", "seconds", "memory_mb", "slowest_ms", "finds")
# For one input; kernels as plain Python are some hundred times slower.
_TIMEOUTS = {"python": 60, "compiled": 10}
# Bytes of an input: what plain Python needs for few samples, what is read of ranges.
_LONGEST = {"python": 256, "compiled": 4096}
_LONGEST_OF = {"rounds": 64, "virtual": 1024, "remainders": 400}
JAVASCRIPT = "javascript"
# No kernel runs in these; in opening all do, and one file takes a minute as plain Python.
_COMPILED_ONLY = (
    "opening",
    "header",
    "pages",
    "metadata",
    "remainders",
    "planner",
    "rounds",
    "virtual",
)


def run_worker(name: str, mode: str, seconds: float) -> dict[str, Any]:
    """Fuzz a target in one mode; go on after crashes and hangs."""
    fields = ("executions", "accepted", "seconds", "finds", "slowest", "memory")
    found = dict.fromkeys(fields, 0.0)
    state = WORK / "state.json"
    while (left := seconds - found["seconds"]) > 2:
        state.unlink(missing_ok=True)
        done = subprocess.run(_command(name, mode, left), cwd=ROOT, env=_environment(mode),
                              capture_output=True, check=False)  # fmt: skip
        if not state.exists():
            raise click.ClickException(done.stderr.decode(errors="replace")[-3000:])
        part = json.loads(state.read_text())
        for field in fields[:4]:
            found[field] += part[field]
        for field in ("slowest", "memory"):
            found[field] = max(found[field], part[field])
        if done.returncode:
            found["seconds"] += 1  # what is not in `state` any more, at most
            # libFuzzer itself has kept the input: crash-…, timeout-…, oom-….
            found["finds"] += 1
            text = done.stderr.decode(errors="replace")
            (WORK / "finds" / f"log-{name}-{mode}-{int(time.time())}.txt").write_text(text[-9000:])
    return found


def _command(name: str, mode: str, seconds: float) -> list[str]:
    if name == JAVASCRIPT:
        return ["node", "js/testing/fuzz.js", str(seconds), str(time.time_ns() % 2**31),
                str(WORK / "finds"), str(WORK / "state.json")]  # fmt: skip
    # Plain Python takes too long for all that is kept of runs that are compiled.
    python = WORK / f"{name}-python"
    kept = [python] if mode == "python" else [WORK / name, python]
    kept[0].mkdir(parents=True, exist_ok=True)
    corpus = [*kept, ROOT / "fuzz" / "corpus" / name]
    if name == "opening":
        corpus.append(ROOT / "tests" / "golden" / "v2")
    return [
        sys.executable, "-m", "fuzz.worker", name, str(WORK / "finds"), str(WORK / "state.json"),
        f"-max_total_time={max(1, int(seconds))}", f"-timeout={_TIMEOUTS[mode]}",
        f"-artifact_prefix={WORK / 'finds'}/{name}-", "-rss_limit_mb=3072",
        f"-max_len={_LONGEST_OF.get(name, _LONGEST[mode])}",
        "-print_final_stats=1", "-verbosity=0", *map(str, filter(Path.exists, corpus)),
    ]  # fmt: skip


def _environment(mode: str) -> dict[str, str]:
    paths = os.pathsep.join([str(ROOT / "src"), str(ROOT), os.environ.get("PYTHONPATH", "")])
    kernels = {"python": {"NUMBA_DISABLE_JIT": "1"}, "compiled": {"NUMBA_BOUNDSCHECK": "1"}}
    return os.environ | {"PYTHONPATH": paths} | kernels.get(mode, {})


def add_row(path: Path, row: dict[str, Any]) -> None:
    """Add a run to the line of its target and mode."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    if path.exists():
        with open(path, newline="", encoding="utf-8") as file:
            rows = {(line["target"], line["mode"]): line for line in csv.DictReader(file)}
    key = row["target"], row["mode"]
    if key in rows:
        old = rows[key]
        for field in ("executions", "accepted", "seconds", "finds"):
            row[field] = round(float(old[field]) + row[field], 1)
        for field in ("memory_mb", "slowest_ms"):
            row[field] = max(float(old[field]), row[field])
    for field in ("executions", "accepted", "finds", "seconds"):
        row[field] = round(row[field])
    rows[key] = row
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows[key] for key in sorted(rows))


def modes_of(name: str) -> dict[str, float]:
    """Return the modes of a target, and the share of its time that each has."""
    if name == JAVASCRIPT:
        return {"node": 1.0}
    if name in _COMPILED_ONLY:
        return {"compiled": 1.0}
    return {"python": 0.2, "compiled": 0.8}


@click.command(help=__doc__)
@click.argument("names", nargs=-1)
@click.option("--seconds", type=float, default=60, help="For each target.")
@click.option("--mode", help="Only this one: python, compiled or node.")
@click.option("--out", type=click.Path(path_type=Path), default=RESULTS)
def main(names: tuple[str, ...], seconds: float, mode: str | None, out: Path) -> None:
    """Fuzz, print a line each, exit 1 if anything is found."""
    from fuzz.targets import TARGETS

    (WORK / "finds").mkdir(parents=True, exist_ok=True)
    n_finds = 0
    for name in names or (*TARGETS, JAVASCRIPT):
        for this, share in modes_of(name).items():
            if mode not in (None, this):
                continue
            found = run_worker(name, this, seconds if mode else share * seconds)
            add_row(out, {
                "target": name, "mode": this, "executions": found["executions"],
                "accepted": found["accepted"], "seconds": found["seconds"],
                "memory_mb": round(found["memory"] / 2**20),
                "slowest_ms": round(1000 * found["slowest"], 1), "finds": found["finds"],
            })  # fmt: skip
            n_finds += int(found["finds"])
            click.echo(f"{name} {this}: " + ", ".join(f"{k} {v:.6g}" for k, v in found.items()))
    if n_finds:
        click.echo(f"{n_finds} finds in {WORK / 'finds'}")
        sys.exit(1)


if __name__ == "__main__":
    main()
