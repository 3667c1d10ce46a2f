"""Time that digests add to `compress`: ``python -m benchmarks.digests DIR/moon*.tif``.

Each raster is compressed with digests and without, in turns, on one thread; the seconds are the
medians of processor time. `digests.csv` names the processor, and says if it has instructions for
SHA-256.
"""

import hashlib
import time
from collections import namedtuple
from functools import partial
from pathlib import Path

import rasterio

import terrainwave
from benchmarks import common

Row = namedtuple(
    "Row", "raster dtype n_samples max_error without_s with_s ratio hash_mb_s has_sha processor"
)


def hash_speed() -> float:
    """Return the megabytes of SHA-256 in a second of processor time."""
    data, start = bytes(1 << 26), time.process_time()
    hashlib.sha256(data)
    return len(data) / (time.process_time() - start) / 1e6


def has_sha() -> bool:
    """Say whether the processor has instructions for SHA-256, as Linux tells."""
    flags = Path("/proc/cpuinfo").read_text().split()
    return "sha_ni" in flags or "sha2" in flags


@common.command("digests.csv")
@common.rasters_argument
@common.bounds_option(1.0)
@common.option("--rounds", type=common.COUNT, default=15)
def main(
    paths: list[Path], bounds: tuple[float, ...], rounds: int, folder: Path, out: Path
) -> None:
    """Measure, print and write the CSV."""
    processor, rows = common.describe_machine()["processor"], []
    for dem in paths:
        with rasterio.open(dem) as dataset:
            dtype, n_samples = dataset.dtypes[0], dataset.width * dataset.height
        for bound in bounds:
            tasks = [
                partial(
                    terrainwave.compress, dem, folder / "out.twz", max_error=bound, digest=digest,
                    threads=1, overwrite=True,
                )
                for digest in (False, True)
            ]  # fmt: skip
            tasks[1]()  # warms up
            before, after = (
                timed.seconds for timed in common.take_turns(lambda: tasks, rounds)  # noqa: B023
            )  # fmt: skip
            rows.append(
                Row(
                    dem.stem, dtype, n_samples, bound, round(before, 3), round(after, 3),
                    round(after / before, 4), round(hash_speed()), has_sha(), processor,
                )
            )  # fmt: skip
    common.write_rows(out, rows)


if __name__ == "__main__":
    main()
