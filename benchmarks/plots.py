"""Draw bits per sample against the bound: ``python -m benchmarks.plots CSV ... --out PNG``.

One panel per raster, one line per codec; reads what ``benchmarks.codecs`` wrote.
"""

import argparse
import csv
import shutil
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import matplotlib.ticker

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"

# Ours strong, the others quiet; the order is that of the legend.
STYLES = {
    "terrainwave-predictive": {"color": "#d1495b", "linewidth": 2.2, "marker": "o"},
    "terrainwave-predictive-fast": {"color": "#d1495b", "linewidth": 0.9, "linestyle": ":"},
    "terrainwave-predictive-best": {"color": "#d1495b", "linewidth": 0.9, "linestyle": "--"},
    "terrainwave-cdf97": {"color": "#edae49", "linewidth": 1.6, "marker": "o"},
    "jxl-e9": {"color": "#30638e"},
    "sz3": {"color": "#00798c"},
    "sz3-interp": {"color": "#00798c", "linestyle": ":"},
    "sperr": {"color": "#003d5b", "linestyle": "--"},
    "jpeg-ls": {"color": "#8d96a3", "linestyle": "--"},
    "lerc": {"color": "#8d96a3", "linestyle": ":"},
    "cog-overviews": {"color": "#8d96a3"},
}

# Lossless stands at 0.05.
X_TICKS = {0.05: "0", 0.1: "0.1", 0.5: "0.5", 1: "1", 3: "3", 10: "10"}

Curves = dict[str, dict[str, list[tuple[float, float]]]]


def read_curves(paths: list[Path]) -> Curves:
    """Return (bound, bits per sample) by raster and codec, in order of the bound."""
    curves: Curves = defaultdict(lambda: defaultdict(list))
    for path in paths:
        if not path.exists():
            continue
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                if row["bits_per_sample"] and not row["problem"]:
                    point = float(row["max_error"]), float(row["bits_per_sample"])
                    curves[row["raster"]][row["codec"]].append(point)
    return curves


def draw(curves: Curves, results: Path) -> None:
    """Write ``rates.png`` among the results, and for the documents if they are the repository's."""
    draw_file(curves, results / "rates.png")
    if results.resolve() == RESULTS:
        shutil.copyfile(results / "rates.png", ROOT / "docs" / "images" / "rates.png")


def _label_of_minor(value: float, _place: int) -> str:
    """Return the number at 2 and 5 times a power of ten, else nothing."""
    return f"{value:g}" if f"{value:e}"[0] in "25" else ""


def draw_file(curves: Curves, out: Path) -> None:
    """Write the figure; lossless points stand at the left edge of each panel."""
    n_cols = 4
    n_rows = -(-(len(curves) + 1) // n_cols)
    figure, axes = plt.subplots(n_rows, n_cols, figsize=(16, 3.4 * n_rows), layout="constrained")
    panels = list(axes.flat)
    for panel, (raster, by_codec) in zip(panels, sorted(curves.items()), strict=False):
        for codec, style in STYLES.items():
            points = sorted(by_codec.get(codec, []))
            if points:
                bounds = [max(bound, 0.05) for bound, _ in points]
                bits = [rate for _, rate in points]
                panel.plot(bounds, bits, label=codec, **{"linewidth": 1.2, "marker": ".", **style})
        panel.set(xscale="log", yscale="log")
        panel.set_xticks(list(X_TICKS), list(X_TICKS.values()))
        panel.xaxis.set_minor_formatter("")
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter(mpl.ticker.FuncFormatter(_label_of_minor))
        panel.set_title(raster, fontsize=9)
        panel.set_xlabel("max error, m")
        panel.set_ylabel("bits per sample")
        panel.grid(alpha=0.3, which="both")
    drawn = {}
    for panel in panels[: len(curves)]:
        handles, labels = panel.get_legend_handles_labels()
        drawn |= dict(zip(labels, handles, strict=True))
    for panel in panels[len(curves) :]:
        panel.axis("off")
    names = [codec for codec in STYLES if codec in drawn]
    legend = panels[len(curves)]
    legend.legend([drawn[name] for name in names], names, loc="center", fontsize=11)
    figure.savefig(out, dpi=80)
    plt.close(figure)


def main() -> int:
    """Parse, read, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("csv", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/rates.png"))
    arguments = parser.parse_args()
    draw_file(read_curves(arguments.csv), arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
