"""Write the measured tables and numbers into documents: ``python -m benchmarks.tables``.

Each table stands between ``<!-- table: NAME -->`` and ``<!-- end -->`` in a document, and the
numbers of a sentence between ``<!-- number: NAME -->`` and the same end. They are made from CSVs
under ``benchmarks/results``, as ``tables.toml`` declares. ``--check`` changes nothing and exits 1
if a document does not say what its CSV says, or a sentence has a figure of neither a CSV nor
``stated``, the settings and limits that pages name.
"""

import itertools
import json
import math
import re
import tomllib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from benchmarks.common import RESULTS, ROOT, code_of, geometric_mean, read_rows

DOCUMENTS = [
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if re.search("<!-- (table|number): ", path.read_text(encoding="utf-8"))
]
RAPID = "terrainwave-rapid"
PREDICTIVE = "terrainwave-predictive"
FAST = f"{PREDICTIVE}-fast"
BEST = f"{PREDICTIVE}-best"
CDF97 = "terrainwave-cdf97"
OUR_CODECS = (RAPID, PREDICTIVE, FAST, BEST, CDF97)
# As a raster's own type, as float32 at the widened bound, and without LERC where lossless: sizes
# are compared with the smallest, speeds with the first, which is what its user makes.
COGS = ("cog", "cog-float32", "cog-zstd")
LARGE = 4_000_000  # samples from which speeds are in the row of large rasters

TABLES = tomllib.loads(Path(__file__).with_name("tables.toml").read_text(encoding="utf-8"))
NUMBERS = TABLES.pop("numbers")
STATED = TABLES.pop("stated")
del TABLES["code"]  # of `common`

Row = dict[str, Any]
Rows = list[Row]


class Missing:
    """A number that was not measured."""

    def __format__(self, spec: str) -> str:
        return "–"

    def __eq__(self, other: object) -> bool:
        return other == ""

    def __getitem__(self, field: str) -> "Missing":
        return self


def is_measured(value: Any) -> bool:
    """Return whether a row of a CSV has the value."""
    return not isinstance(value, Missing)


def markdown(name: str, results: Path) -> str:
    """Return a table of ``tables.toml`` as Markdown."""
    table = TABLES[name]
    rows = rows_of(table, results)
    columns = table["columns"].replace("\n|", " |").split(" | ")
    headings, cells = zip(*(column.split(" = ") for column in columns))
    lines = [list(headings), *([cell.format_map(row) for cell in cells] for row in rows)]
    if rows:
        means = _Means(rows)
        lines += [line.format_map(means).split(" | ") for line in table.get("last", [])]
    texts = [re.sub("  +", " ", f"| {' | '.join(line)} |") for line in lines]
    notes: dict[str, str] = {}
    texts.insert(1, "|---" * len(cells) + "|")
    for field in re.findall(r"{(\w+)}", table.get("note", "")):
        values = sorted({row[field] for row in rows})
        notes[field] = ", ".join(v if isinstance(v, str) else f"{v:g}" for v in values)
    texts += ["", table["note"].format_map(notes)] if notes else []
    return "\n".join([*texts, *provenance(name, results)])


def provenance(name: str, results: Path) -> list[str]:
    """Return lines that say what measured a table, and whether the code has changed since."""
    table = TABLES[name]
    found: dict[str, list[str]] = defaultdict(list)
    for one in table.get("csv", [table["rows"]]):
        path = find(results, one).with_suffix(".json")
        if not path.exists():
            continue
        about = json.loads(path.read_text(encoding="utf-8"))
        machines: dict[str, Rows] = defaultdict(list)
        for machine in (*about.pop("earlier", []), about):
            machines[machine["processor"]].append(machine)
        measured = {row.get("processor") for row in read(results, one)} - {None} or set(machines)
        for processor in measured & machines.keys():
            commits = {line["commit"] or "unknown": None for line in machines[processor]}
            how = f"commit {', '.join(commits)} on {processor}"
            if path.parent.name == "archive":
                how += "; **by a script that is gone**"
            elif code_of(one) and {m.get("code") for m in machines[processor]} != {code_of(one)}:
                how += "; **the code has changed since**"
            found[how].append(f"`{one}.csv`")
    lines = [f"Measured at {how} ({', '.join(names)})." for how, names in sorted(found.items())]
    if "brief" in table:
        on = sorted({how.partition(" on ")[2].partition(";")[0] for how in found})
        lines = [f"Measured on {' and '.join(on)} ({table['brief']})."]
        if old := sorted({name for how in found if ";" in how for name in found[how]}):
            lines[0] += f" **Since then the code has changed** ({', '.join(old)}, in part)."
    return ["", *lines] if lines else []


def numbers(name: str, results: Path) -> str:
    """Return the numbers of a sentence, those of a table's rows that ``tables.toml`` names."""
    asked = NUMBERS[name]
    table = TABLES[asked["table"]] | ({"group": []} if "of" in asked else {}) | asked
    (row,) = rows_of(table, results)
    text: str = table["text"].format_map(row)
    return text


def rows_of(table: dict[str, Any], results: Path) -> Rows:
    """Return the rows of a table, as its fields say, from "rows" to "total"."""
    make_rows = globals().get(table["rows"])
    rows: Rows = make_rows(results) if make_rows else read(results, table["rows"])
    for field, value in table.get("where", {}).items():
        rows = [row for row in rows if row[field] == value]
    for field, value in table.get("unless", {}).items():
        rows = [row for row in rows if row[field] != value]
    if "pivot" in table:
        rows = pivot(rows, *table["pivot"])
    for field, formula in table.get("derived", {}).items():
        rows = [row | {field: calculate(formula, row)} for row in rows]
    rows = sorted(rows, key=lambda row: [row[field] for field in table.get("sort", ())])
    if "group" in table:
        rows = grouped(rows, table["group"], table["of"])
    if "total" in table:
        rows = rows + [row | table["total"] for row in grouped(rows, [], table["of"])]
    return rows


# What tables make of the values of a field.
GROUPED: dict[str, Callable[[list], Any]] = {
    "mean": geometric_mean, "least": min, "most": max, "sum": sum, "count": len,
    "distinct": lambda values: len({*values}),
    "positive": lambda values: sum(value > 0 for value in values),
}  # fmt: skip


def grouped(rows: Rows, by: list[str], of: dict[str, str]) -> Rows:
    """Return a row for each value of the fields `by`, with what `of` says: "sum seconds"."""
    found: dict[tuple, Rows] = defaultdict(list)
    for row in rows:
        found[tuple(row[field] for field in by)].append(row)
    asked = {name: what.split(" ") for name, what in of.items()}
    return [
        dict(zip(by, case, strict=True))
        | {name: GROUPED[how]([row[field] for row in own]) for name, (how, field) in asked.items()}
        for case, own in found.items()
    ]


class _Means(dict[str, float]):
    """Geometric means of columns."""

    def __init__(self, rows: Rows) -> None:
        super().__init__()
        self._rows = rows

    def __missing__(self, name: str) -> float:
        return geometric_mean([row[name] for row in self._rows])


def read(results: Path, name: str, **derived: Callable[[Row], Any]) -> Rows:
    """Return the rows of ``NAME.csv`` with fields derived from others; none if it is not there."""
    lines = read_rows(find(results, name))
    rows = [{key: Missing() if v == "" else v for key, v in line.items()} for line in lines]
    return [row | {name: make(row) for name, make in derived.items()} for row in rows]


def find(results: Path, name: str) -> Path:
    """Return where a CSV lies: among the results, or those of scripts that are gone."""
    path = results / f"{name}.csv"
    return path if path.exists() else results / "archive" / path.name


def calculate(formula: str, row: Row) -> float | Missing:
    """Return one field or number over or less another: ``regular / triangles``."""
    left, sign, right = re.split(" ([/-]) ", formula)
    texts = [name if name[0].isdigit() else f"{{{name}}}".format_map(row) for name in (left, right)]
    try:
        one, two = map(float, texts)
    except ValueError:
        return Missing()
    return one / two if sign == "/" else one - two


def pivot(rows: Rows, by: tuple[str, ...], over: str) -> Rows:
    """Return a row for each value of the fields `by`, all lines of it by the value of `over`.

    They stand under the names "over=value"; where a case has none, it is missing. `over` may be
    several fields, with spaces between them and between their values.
    """
    found: dict[tuple, Row] = {}
    values = [" ".join(str(row[name]) for name in over.split(" ")) for row in rows]
    for row, value in zip(rows, values, strict=True):
        case = found.setdefault(tuple(row[name] for name in by), {name: row[name] for name in by})
        case[f"{over}={value}"] = row
    none = {f"{over}={value}": Missing() for value in values}
    return [case | none | case for case in found.values()]  # in the order of the case


def javascript_side(results: Path) -> Rows:
    """Return reads in JavaScript, with who reads in words."""
    words = {0: "one thread"}
    by = lambda row: words.get(row["workers"], f"{row['workers']} workers")  # noqa: E731
    return read(results, "javascript_side", by=by)


def paper(results: Path) -> Rows:
    """Return what 10^12 samples take on paper, numbers as texts: they span twelve decades."""
    rows = read(results, "scale_paper")
    for row, name in itertools.product(rows, ("measured", "paper")):
        value = row[name]
        is_known = is_measured(value) and not math.isnan(value)
        row[name] = f"{value:,.0f}" if is_known and value >= 10 else f"{value:.2g}"
        row[name] = row[name] if is_known else "–"
    return rows


def same_bytes(results: Path) -> Rows:
    """Return environments; what was switched off is in their names, and long."""
    return read(results, "same_bytes", cpu=lambda row: row["cpu"].split(" ")[0])


def size_rows(results: Path, *names: str) -> Rows:
    """Return rows of CSVs of sizes, without those of cases that went wrong.

    Bounds below 1 are for floats only: on whole metres they are lossless once more.
    """
    rows = [row for name in names for row in read(results, name) if not is_measured(row["problem"])]
    return [
        row for row in rows if not (row["dtype"].startswith("int") and 0 < row["max_error"] < 1)
    ]


def compared_codecs(results: Path) -> Rows:
    """Return bits per sample of our codecs and the best peer by raster and bound."""
    found: dict[tuple[str, float], Row] = defaultdict(dict)
    for row in size_rows(results, "rapid", "predictive", "cdf97", "peers"):
        found[row["raster"], row["max_error"]][row["codec"]] = row["bits_per_sample"]
    cases = []
    for (raster, bound), peers in sorted(found.items()):
        ours = {name: peers.pop(name, Missing()) for name in OUR_CODECS}
        cog = min((peers.pop(name) for name in COGS if name in peers), default=math.nan)
        if peers and is_measured(ours[RAPID]):
            best, name = min((bits, name) for name, bits in peers.items())
            row = {"raster": raster, "bound": bound, "cog": cog, "best": best, "best_peer": name}
            cases.append(row | ours | {"ratio": ours[RAPID] / best})
    return cases


GROUPS: dict[str, Callable[[Row], bool]] = {
    "all cases": lambda case: True,
    "lossless": lambda case: case["bound"] == 0,
    "best peer below 1 bit/sample": lambda case: case["best"] < 1,
}


def _ratio(cases: Rows, codec: str, peer: str = "best", of: Any = geometric_mean) -> Any:
    ratios = [case[codec] / case[peer] for case in cases if is_measured(case[codec])]
    return of(ratios) if ratios else Missing()


def _groups(results: Path) -> dict[str, Rows]:
    cases = compared_codecs(results)
    return {name: [case for case in cases if rule(case)] for name, rule in GROUPS.items()}


def summarized_cases(results: Path) -> Rows:
    """Return sizes of the default over the best peer's and over COGs', by groups of cases."""
    return [
        {"cases": name, "number": len(group)}
        | {other: _ratio(group, RAPID, other) for other in ("best", "cog")}
        | {f"{other} largest": _ratio(group, RAPID, other, of=max) for other in ("best", "cog")}
        for name, group in _groups(results).items()
        if group
    ]


def summarized_methods(results: Path) -> Rows:
    """Return the same means for each of our methods and efforts."""
    groups = _groups(results)
    cases = groups["all cases"]
    return [
        {"codec": codec, "number": number, "of": len(cases)}
        | {"largest": _ratio(cases, codec, of=max)}
        | {name: _ratio(group, codec) for name, group in groups.items()}
        for codec in OUR_CODECS
        if (number := sum(is_measured(case[codec]) for case in cases))
    ]


def speed_cases(results: Path) -> Rows:
    """Return each codec's speeds in each case, and over those of the COG it took turns with."""
    found: Rows = []
    by = "raster", "max_error", "is_slow", "processor"
    turns = pivot(read(results, "speeds"), by, "codec")
    for turn in turns:
        lines = [row for name, row in turn.items() if "=" in name and is_measured(row)]
        (cog,) = (row for row in lines if row["codec"] == "cog")
        for row in lines:
            if row is cog and row["is_slow"] == "True":
                continue
            found.append(
                row
                | {"is_large": row["n_samples"] >= LARGE}
                | {"group": "lossy" if row["max_error"] else "lossless"}
                | {
                    f"{what} / COG": row[f"{what}_speed"] / cog[f"{what}_speed"]
                    for what in ("encode", "decode")
                }
            )
    return found  # fmt: skip


def compared_speeds(results: Path) -> Rows:
    """Return each codec's mean and least speeds by processor and size of rasters."""
    found: dict[tuple, Row] = defaultdict(lambda: defaultdict(list))
    for row in speed_cases(results):
        means = found[row["is_large"], row["processor"], row["codec"]]
        for what in ("encode", "decode"):
            means[f"{what} {row['group']}"].append(row[f"{what}_speed"])
            means[f"{what} {row['group']} / COG"].append(row[f"{what} / COG"])
    fields = [f"{what} {group}{end}" for what in ("encode", "decode")
              for group in ("lossless", "lossy") for end in ("", " / COG", " least")]  # fmt: skip
    lines = []
    for (is_large, processor, codec), values in found.items():
        least = {key.replace("/ COG", "least"): min(v) for key, v in values.items() if "/" in key}
        means = {key: geometric_mean(v) for key, v in values.items()}
        line = {"codec": codec, "is_large": is_large, "processor": processor}
        line["rasters"] = "4 Mpx and more" if is_large else "1 to 4 Mpx"
        lines.append(dict.fromkeys(fields, Missing()) | line | means | least)
    return sorted(lines, key=lambda line: (line["processor"], not line["is_large"]))


def default_reads(results: Path) -> Rows:
    """Return how fast files of the default are read, by raster and bound, beside the COG."""
    return [
        row | {"cog_speed": row["decode_speed"] / row["decode / COG"], "ratio": row["decode / COG"]}
        for row in speed_cases(results)
        if row["codec"] == f"{RAPID}+"
    ]


def archives(results: Path) -> Rows:
    """Return what the smaller methods save of the default's size, and what they cost in time.

    Each time is over that of the COG of its turns, which may be of another processor.
    """
    cases = compared_codecs(results)
    fields = "codec", "raster", "max_error"
    speeds = {tuple(row[field] for field in fields): row for row in speed_cases(results)}
    found = []
    for codec, name in ((PREDICTIVE, "`--method predictive`"), (BEST, "`--effort best`")):
        sizes = [case[codec] / case[RAPID] for case in cases if is_measured(case[codec])]
        row = {"codec": name, "cases": len(sizes), "mean": geometric_mean(sizes) if sizes else 0}
        row |= {"least": min(sizes, default=0), "most": max(sizes, default=0)}
        for what in ("decode", "encode"):
            times = [
                speeds[RAPID, *case][f"{what} / COG"] / line[f"{what} / COG"]
                for (other, *case), line in speeds.items()
                if other == codec and (RAPID, *case) in speeds
            ]
            row[what] = geometric_mean(times) if times else Missing()
            row[f"{what} most"] = max(times, default=Missing())
        found.append(row)
    return found if cases else []


# What tables that compare call codecs, and theirs in the CSVs of sizes and of speeds.
SIDE_BY_SIDE = {
    "terrainwave": (RAPID, f"{RAPID}+"),
    "terrainwave without the proof": (RAPID, RAPID),
    "terrainwave, `--method predictive`, likewise": (PREDICTIVE, PREDICTIVE),
    "COG, LERC_ZSTD": ("cog", "cog"),
    "COG, LERC_ZSTD of float32": ("cog-float32", "cog-float32"),
    "JPEG XL": ("jxl-e9", "jxl-e7"),
    "JPEG XL, fast mode": ("jxl-e1", "jxl-e1"),
    "LERC alone": ("lerc", "lerc"),
    "SZ3": ("sz3", "sz3"),
    "SPERR": ("sperr", "sperr"),
}
_SHORT = (RAPID, "cog", "jxl-e9", "sz3", "sperr")  # in README's table, the first line of each


def side_by_side(results: Path) -> Rows:
    """Return sizes over the smallest COG's, and speeds on one thread, on the slowest processor.

    Sizes of all rasters; speeds of those of 4 Mpx and more, and of others under names in "small".
    """
    sizes: dict[str, dict[tuple, float]] = defaultdict(dict)
    for row in size_rows(results, "rapid", "predictive", "peers"):
        sizes[row["codec"]][row["raster"], row["max_error"]] = row["n_bytes"]
    speeds: dict[str, Row] = defaultdict(dict)
    for line in compared_speeds(results):
        least = speeds[line["codec"]]
        for key, value in line.items():
            name = key if line["is_large"] else f"small {key}"
            if key.endswith(("/ COG", "least")):
                both = [one for one in (value, least.get(name, value)) if is_measured(one)]
                least[name] = min(both, default=Missing())
    if not (sizes and speeds):
        return []
    cogs = {
        case: min(sizes[cog][case] for cog in COGS if case in sizes[cog]) for case in sizes["cog"]
    }
    found, shown = [], set[str]()
    for name, (codec, timed) in SIDE_BY_SIDE.items():
        if not (codec in sizes and timed in speeds):
            continue
        # As float32 alone is not another case: the raster's own type stands for it.
        known = sizes["cog"] | sizes[codec] if codec in COGS else sizes[codec]
        ratios = {case: size / cogs[case] for case, size in known.items() if case in cogs}
        row = {"codec": name, "is_first": codec in _SHORT and codec not in shown}
        for group, values in (
            ("all", [*ratios.values()]),
            ("lossless", [ratio for (_, bound), ratio in ratios.items() if not bound]),
            ("lossy", [ratio for (_, bound), ratio in ratios.items() if bound]),
        ):
            row |= {group: geometric_mean(values), f"{group} largest": max(values)}
        shown.add(codec)
        row["cases"] = len(ratios)
        row |= speeds[timed]
        row |= {"reads": row["decode lossy / COG"], "slowest_reads": row["decode lossy least"]}
        found.append(row)
    return found


def tile_bytes(results: Path) -> Rows:
    """Return the kilobytes of a tile of SRTM, ours and of the smallest COG."""
    rows = [row for row in size_rows(results, "rapid", "peers") if "aconcagua" in row["raster"]]
    found: Row = {}
    for name, bound in (("lossless", 0), ("bounded", 1)):
        cases = [row for row in rows if row["max_error"] == bound]
        for who, codecs in (("ours", (RAPID,)), ("cog", COGS)):
            n_bytes = [row["n_bytes"] for row in cases if row["codec"] in codecs]
            found[f"{who} {name}"] = min(n_bytes, default=math.nan) / 1000
    return [rows[0] | found] if rows else []


def fine_cases(results: Path) -> Rows:
    """Return bits per sample by codec of rasters of floats within fine bounds."""
    found = []
    for case in pivot(size_rows(results, "fine"), ("raster", "max_error"), "codec"):
        bits = {
            name.removeprefix("codec="): line["bits_per_sample"]
            for name, line in case.items()
            if "=" in name
        }
        least = lambda *names: min(bits[name] for name in names if is_measured(bits[name]))  # noqa: E731,B023
        bits |= {"lerc": least("cog", "cog-float32")}
        bits |= {"lerc-bare": least("cog-bare", "cog-float32-bare")}
        smallest = least("lerc", "cog-steps-zstd", "cog-steps-deflate")
        row = {"cog": bits[RAPID] / smallest, "n_bytes": case[f"codec={RAPID}"]["n_bytes"]}
        row["bare"] = bits[RAPID] / least("lerc-bare", "cog-steps-zstd-bare")
        found.append(case | bits | row)
    return found


def viewed_frames(results: Path) -> Rows:
    """Return frames of the viewer; what was not timed, or not drawn, is missing."""
    rows = read(results, "render")
    cpu = ("median_cpu", "p99_cpu", "median_page", "median_select", "median_submit")
    for row in rows:
        frames = [row["median_frame"], row["p99_frame"]]
        is_drawn = "CPU" not in row["what"]
        row["rate"], row["low"] = (1000 / ms if is_drawn else Missing() for ms in frames)
        row |= {} if row["p99_cpu"] > 0 else dict.fromkeys(cpu, Missing())
    return rows


def methods_at_bounds(results: Path) -> Rows:
    """Return all methods at the same bounds, with their goals in words."""
    words = {"max_error": "{max_error:g} m", "rate": "size of predictive at {max_error:g} m"}
    return read(results, "systems_methods", goal=lambda row: words[row["goal"]].format_map(row))


def remote_windows(results: Path) -> Rows:
    """Return what windows over http cost."""
    return read(results, "remote", level=lambda row: str(row["level"]).replace("-", "−"))


REPORTED = ("summary", "methods", "archives", "speeds", "default_reads", "cases")  # in bench.md
_SLOT = re.compile(r"<!-- (table|number): (\w+) -->.*?<!-- end -->", re.DOTALL)


def fill_in(text: str) -> str:
    """Return a document with all tables and numbers made anew."""

    def make(slot: re.Match[str]) -> str:
        kind, name = slot.groups()
        made = numbers(name, RESULTS) if kind == "number" else f"\n{markdown(name, RESULTS)}\n"
        return f"<!-- {kind}: {name} -->{made}<!-- end -->"

    return _SLOT.sub(make, text)


# Pages of formats and of decisions, which are dated, are no pages of figures.
PAGES = [
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md")))
    if path.parent.name != "decisions" and not path.name.lower().startswith("format")
]
_UNITS = (
    "times (?:as|the|more|less|slower|faster|longer)|Msamples/s|[GM]i?B/s|ns|ms|bits per sample|"
    "bits/sample|(?:CPU|processor) seconds|[kMG]i?B|requests|triangles|seconds|s|minutes|hours"
)
_FIGURE = re.compile(rf"(?<![\w.])\d[\d,.]* ?(?:%|(?:{_UNITS})\b)|\b0\.\d+ of\b")
# Not prose: what CSVs fill in, code, tables.
_NO_PROSE = re.compile(rf"{_SLOT.pattern}|```.*?```|`[^`]*`|^\|.*?$", re.DOTALL | re.MULTILINE)


def figures_by_hand(page: str) -> list[str]:
    """Return the figures of a page's sentences that neither a CSV fills in nor `STATED` names."""
    text = _NO_PROSE.sub("", (ROOT / page).read_text(encoding="utf-8"))
    return sorted(set(_FIGURE.findall(text)) - set(STATED.get(page, ())))


def write_all(results: Path) -> list[str]:
    """Write ``bench.md``, and the documents if these are the repository's results."""
    text = "\n\n".join(markdown(name, results) for name in REPORTED) + "\n"
    (results / "bench.md").write_text(text, encoding="utf-8")
    return ["bench.md", *(write_documents() if results.resolve() == RESULTS else [])]


def write_documents(*, only_check: bool = False) -> list[str]:
    """Fill in all documents; return the names of those that change."""
    changed = []
    for name in DOCUMENTS:
        path = ROOT / name
        text = path.read_text(encoding="utf-8")
        new = fill_in(text)
        if new != text:
            changed.append(name)
            if not only_check:
                path.write_text(new, encoding="utf-8")
    return changed


@click.command(help=__doc__)
@click.option("--check", is_flag=True, help="Change nothing; exit 1 if one is old.")
def main(check: bool) -> None:
    """Fill in or check tables and numbers."""
    for name in (changed := write_documents(only_check=check)):
        click.echo(
            f"{name}: {'a table or number is not what its CSV says' if check else 'written'}"
        )
    unknown = [f"{page}: {', '.join(found)}" for page in PAGES if (found := figures_by_hand(page))]
    for line in unknown:
        click.echo(
            f"{line}: measured? Then let a CSV fill it in; else name it in tables.toml, stated"
        )
    raise SystemExit(check and bool(changed + unknown))


if __name__ == "__main__":
    main()
