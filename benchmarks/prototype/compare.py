"""Processor time of whole reads, in turns: a COG LERC_ZSTD, today's library, the prototype.

`python compare.py DATA CASE ...`, where `fit.py` has written CASE.bin, and CASE.twz is the file of
today's method. Prints the table of docs/decisions/0034.
"""

import statistics
import subprocess
import sys
import time
from pathlib import Path

import rasterio
from rasterio.shutil import copy


def run(*command):
    """Return the median that a program prints, ns a sample, and all that it prints."""
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    line = next(line for line in reversed(printed.splitlines()) if "median " in line)
    return float(line.split("median ")[1].split()[0]), printed


print(
    "| case | COG, ns a sample | today | prototype | today / prototype | bits today | prototype |"
)
print("|---|---|---|---|---|---|---|")
rows = []
for case in sys.argv[2:]:
    name, bound = case.rsplit("@", 1)
    cog = Path(f"{case}.cog.tif")
    if not cog.exists():
        copy(
            f"{sys.argv[1]}/{name}.tif", cog, driver="COG", COMPRESS="LERC_ZSTD", MAX_Z_ERROR=bound
        )
    with rasterio.open(cog) as dataset:
        n = dataset.width * dataset.height
    times = [], [], []
    for _ in range(4):
        times[1].append(run("./today", f"{case}.twz", "3")[0])
        own, printed = run("./unit", f"{case}.bin", "3")
        times[2].append(own)
        start = time.process_time()
        with rasterio.open(cog) as dataset:
            dataset.read(1)
        times[0].append((time.process_time() - start) / n * 1e9)
    a, b, c = (statistics.median(part) for part in times)
    bits = float(printed.split("bits/sample (tables")[0].rsplit(":", 1)[1])
    rows.append((a / b, a / c, b / c))
    before = Path(f"{case}.twz").stat().st_size * 8 / n
    print(f"| {case} | {a:.1f} | {b:.1f} | {c:.1f} | {b / c:.2f} | {before:.4f} | {bits:.4f} |")
means = [statistics.geometric_mean(column) for column in zip(*rows, strict=True)]
print(
    f"\nGeometric means: today {means[0]:.2f} times the COG's speed, the prototype {means[1]:.2f}, "
)
print(f"the prototype {means[2]:.2f} times today's.")
