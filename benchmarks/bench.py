"""All measurements in one command: ``make bench DATA=DIR``, ``python -m benchmarks.bench DIR``.

Sizes and errors of terrainwave and its peers at equal bounds, then speeds in turns, then the
tables in the documents, ``bench.md`` and the plot. A run that was stopped goes on where it was.
After a change of a codec, name its CSV: ``--again predictive speeds``.

Exit status: 0 good; 1 if a codec broke a bound or failed; 2 wrong usage.
"""

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import click
import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

from benchmarks import codecs, common, tables
from benchmarks.peers import make_codecs
from benchmarks.tables import COGS

# Codecs that share a CSV: names for `make_codecs`, and our methods.
FAMILIES = {
    "predictive": (["terrainwave"], ["predictive", "predictive-fast", "predictive-best"]),
    "rapid": (["terrainwave"], ["rapid"]),
    "cdf97": (["terrainwave"], ["cdf97"]),
    "peers": (
        ["sperr", "sz3", "sz3-interp", "jxl-e9", "jxl-e1", "lerc", *COGS], [],
    ),
    "fine": (
        ["cog", "cog-float32", "cog-bare", "cog-float32-bare", "cog-steps-zstd",
         "cog-steps-zstd-bare", "cog-steps-deflate", "jxl-e9", "terrainwave"], ["rapid"],
    ),
    "speeds": (
        ["sperr", "sz3", "jxl-e7", "jxl-e1", "lerc", *COGS, "terrainwave"],
        ["rapid+", "rapid", "predictive", "predictive-best", "cdf97"],
    ),
}  # fmt: skip
# Ours strong, the others quiet; the order is that of the legend.
STYLES = {
    "terrainwave-rapid": {"color": "#d1495b", "linewidth": 2.2, "marker": "o"},
    "terrainwave-predictive": {"color": "#d1495b", "linewidth": 0.9, "linestyle": "--"},
    "terrainwave-cdf97": {"color": "#edae49", "linewidth": 1.6, "marker": "o"},
    "jxl-e9": {"color": "#30638e"},
    "sz3": {"color": "#00798c"},
    "sz3-interp": {"color": "#00798c", "linestyle": ":"},
    "sperr": {"color": "#003d5b", "linestyle": "--"},
    "cog": {"color": "#8d96a3"},
    "cog-float32": {"color": "#8d96a3", "linestyle": ":"},
}
# Lossless stands at 0.05.
X_TICKS = {0.05: "0", 0.1: "0.1", 0.5: "0.5", 1: "1", 3: "3", 10: "10"}
N_COLS = 4

Curves = dict[str, dict[str, list[tuple[float, float]]]]


def read_curves(paths: Iterable[Path]) -> Curves:
    """Return (bound, bits per sample) by raster and codec, in order of the bound."""
    curves: Curves = defaultdict(lambda: defaultdict(list))
    for path in paths:
        for row in common.read_rows(path):
            if not row["problem"]:
                point = row["max_error"], row["bits_per_sample"]
                curves[row["raster"]][row["codec"]].append(point)
    return curves


def draw(curves: Curves, results: Path) -> None:
    """Write ``rates.png`` among the results, and for the documents if they are the repository's."""
    n_rows = -(-(len(curves) + 1) // N_COLS)
    figure, axes = plt.subplots(n_rows, N_COLS, figsize=(16, 3.4 * n_rows), layout="constrained")
    panels = list(axes.flat)
    drawn = {}
    for panel, (raster, by_codec) in zip(panels, sorted(curves.items()), strict=False):
        for codec, style in STYLES.items():
            points = sorted(by_codec.get(codec, []))
            if points:
                bounds = [max(bound, 0.05) for bound, _ in points]
                bits = [rate for _, rate in points]
                (drawn[codec],) = panel.plot(
                    bounds, bits, **{"linewidth": 1.2, "marker": ".", **style}
                )
        panel.set(xscale="log", yscale="log", xlabel="max error, m", ylabel="bits per sample")
        panel.set_xticks(list(X_TICKS), list(X_TICKS.values()))
        panel.xaxis.set_minor_formatter("")
        panel.yaxis.set_major_formatter("{x:g}")
        # At 2 and 5 times a power of ten.
        panel.yaxis.set_minor_formatter(lambda y, _: f"{y:g}" if f"{y:e}"[0] in "25" else "")
        panel.set_title(raster, fontsize=9)
        panel.grid(alpha=0.3, which="both")
    for panel in panels[len(curves) :]:
        panel.axis("off")
    names = [codec for codec in STYLES if codec in drawn]
    panels[len(curves)].legend([drawn[name] for name in names], names, loc="center", fontsize=11)
    figure.savefig(results / "rates.png", dpi=80)
    plt.close(figure)
    if results.resolve() == common.RESULTS:
        picture = Image.open(results / "rates.png").convert("RGB").quantize(160)
        picture.save(common.IMAGES / "rates.png", optimize=True)


@common.command()
@common.rasters_argument
@common.choices_option("--only", "parts", of=FAMILIES)
@common.choices_option("--again", of=FAMILIES, default=())
@click.option("--fast", is_flag=True, help="Of speeds, only those of fast codecs.")
@common.bounds_option(*codecs.BOUNDS)
def main(paths, parts, again, fast, bounds, folder, out) -> None:
    """Measure what is missing; write CSVs, tables and the plot."""
    common.pin_to_cores()
    for part in again:
        if part == "speeds":
            # Other processors' rows stay; slow codecs have a COG of their own.
            common.keep_rows(
                out / "speeds.csv",
                lambda row: (
                    row["processor"] != common.processor() or (fast and row["is_slow"] == "True")
                ),
            )
        else:
            (out / f"{part}.csv").unlink(missing_ok=True)
    rows = []
    for part in parts:
        own, file = make_codecs(*FAMILIES[part], folder), out / f"{part}.csv"
        if part == "speeds":
            own = [codec for codec in own if not (fast and codec.name.startswith(codecs.SLOW))]
            common.write_rows(file, codecs.measure_speeds(paths, out, own), append=True)
            continue
        of = codecs.FINE if part == "fine" else bounds
        cases = codecs.measure_missing(paths, own, of, codecs.read_cases(file))
        rows += common.write_rows(file, cases, append=True)
    for document in tables.write_all(out):
        click.echo(f"wrote {document}")
    draw(
        read_curves(out / f"{name}.csv" for name in ("rapid", "predictive", "cdf97", "peers")), out
    )
    codecs.exit_with_failures(rows)


if __name__ == "__main__":
    main()
