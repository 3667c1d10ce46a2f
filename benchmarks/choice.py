"""What `auto` sees in windows, and what files tell: ``python -m benchmarks.choice DIR``.

The cases are those of `rapid.csv`; what files save is of that, `predictive.csv` and `peers.csv`
beside the output. A compression ends where the method is settled.
"""

from collections import defaultdict, namedtuple
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import terrainwave
from benchmarks import common
from terrainwave.write import choice

Row = namedtuple(
    "Row",
    "raster max_error is_tried is_predictive windows_saved_percent windows_saved_bits"
    " files_saved_percent files_saved_bits rapid_over_peer predictive_over_peer",
)
PEERS = ("jxl-e9", "sz3", "sz3-interp", "sperr")
RAPID, PREDICTIVE = "terrainwave-rapid", "terrainwave-predictive"


class _SettledError(Exception):
    """Ends a compression."""


def windows_of(source: Path, max_error: float, target: Path) -> tuple[int, int, int, bool]:
    """Return the bytes that `predictive` saves in windows, those of `rapid`, and the samples.

    And whether `predictive` is tried.
    """
    tries = []

    def may_be_worth(*numbers) -> bool:
        tries.append(is_tried(*numbers))
        return True

    is_tried = choice._may_be_worth
    with (
        mock.patch.object(choice, "_may_be_worth", may_be_worth),
        mock.patch.object(choice, "_is_worth", side_effect=_SettledError) as asked,
    ):
        try:
            terrainwave.compress(source, target, max_error=max_error, threads=1, mesh="none")
        except _SettledError:
            return (*asked.call_args.args, tries[0])
    raise AssertionError(f"{source.name} has no windows")


def measure(rasters: dict[str, Path], results: Path, folder: Path) -> Iterator[Row]:
    """Yield a row for each case."""
    bits: dict[tuple[str, float], dict[str, float]] = defaultdict(dict)
    for name in ("rapid.csv", "predictive.csv", "peers.csv"):
        for row in common.read_rows(results / name):
            bits[row["raster"], row["max_error"]][row["codec"]] = row["bits_per_sample"]
    for (raster, bound), by_codec in sorted(bits.items()):
        if raster not in rasters:
            continue
        *saved, is_tried = windows_of(rasters[raster], bound, folder / "choice.twz")
        n_saved, n_bytes, n_samples = saved
        rapid, predictive = by_codec[RAPID], by_codec[PREDICTIVE]
        peer = min(by_codec[name] for name in PEERS)
        yield Row(
            raster, bound, int(is_tried), int(is_tried and choice._is_worth(*saved)),
            round(100 * n_saved / n_bytes, 2), round(8 * n_saved / n_samples, 4),
            round(100 * (1 - predictive / rapid), 1), round(rapid - predictive, 3),
            round(rapid / peer, 3), round(predictive / peer, 3),
        )  # fmt: skip


@common.command("choice.csv")
@common.rasters_argument
def main(paths, folder, out) -> None:
    """Write what windows and files save by `predictive` to a CSV."""
    common.write_rows(out, measure({path.stem: path for path in paths}, out.parent, folder))


if __name__ == "__main__":
    main()
