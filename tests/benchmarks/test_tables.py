"""Do documents get the tables and the numbers of sentences that their CSVs have?"""

import json
import re
from fnmatch import fnmatch

import pytest

from benchmarks import common, tables

WRITE = "raster,reader,ms\na,ours,4\na,cog,2\nb,ours,3\nb,cog,1\n"
TABLE = {
    "rows": "x", "pivot": [["raster"], "reader"],
    "derived": {"ratio": "reader=ours[ms] / reader=cog[ms]"},
    "columns": "raster = {raster} | ours / COG = {ratio:.1f}",
}  # fmt: skip
MOST = {"table": "x", "of": {"most": "most ratio", "least": "least ratio"}, "text": "{most:.1f}"}


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A folder with one CSV, of which there is a table, and a number in a sentence."""
    (tmp_path / "x.csv").write_text(WRITE, encoding="utf-8")
    monkeypatch.setattr(tables, "RESULTS", tmp_path)
    monkeypatch.setattr(tables, "TABLES", {"x": TABLE})
    monkeypatch.setattr(tables, "NUMBERS", {"most": MOST})
    return tmp_path


def test_tables_and_numbers_of_a_document_become_those_of_the_csv(results):
    old = "At most <!-- number: most -->9<!-- end -->.\n<!-- table: x -->\nold\n<!-- end -->\n"
    assert tables.fill_in(old) == (
        "At most <!-- number: most -->3.0<!-- end -->.\n"
        "<!-- table: x -->\n| raster | ours / COG |\n|---|---|\n| a | 2.0 |\n| b | 3.0 |\n"
        "<!-- end -->\n"
    )


def test_a_case_that_lacks_a_reader_has_no_ratio(results):
    (results / "x.csv").write_text(WRITE.replace("b,cog,1\n", ""), encoding="utf-8")
    assert tables.markdown("x", results).endswith("| b | – |")


def test_rows_are_grouped_and_totalled():
    rows = [{"by": "a", "n": 2.0}, {"by": "b", "n": 3.0}, {"by": "a", "n": 8.0}]
    of = {"n": "sum n", "mean": "mean n", "most": "most n", "count": "count n"}
    assert tables.grouped(rows, ["by"], of) == [
        {"by": "a", "n": 10.0, "mean": pytest.approx(4.0), "most": 8.0, "count": 2},
        {"by": "b", "n": 3.0, "mean": pytest.approx(3.0), "most": 3.0, "count": 1},
    ]
    assert tables.grouped(rows, [], {"n": "sum n"}) == [{"n": 13.0}]


@pytest.mark.parametrize(("code", "is_old"), [("now", False), ("before", True), (None, True)])
def test_a_table_says_what_measured_it_and_whether_the_code_has_changed(
    results, monkeypatch, code, is_old
):
    monkeypatch.setattr(tables, "code_of", lambda name: "now")
    about = {"processor": "P", "commit": "c0ffee"} | ({"code": code} if code else {})
    (results / "x.json").write_text(json.dumps(about), encoding="utf-8")
    line = tables.markdown("x", results).splitlines()[-1]
    assert line.startswith("Measured at commit c0ffee on P")
    assert ("code has changed" in line) == is_old


def test_code_gets_old_by_edits_but_not_by_comments(tmp_path, monkeypatch):
    monkeypatch.setattr(common, "ROOT", tmp_path)
    monkeypatch.setattr(common, "CODE", {"a": {"of": ["src/*"], "csv": ["x"]}})

    def digest(python, c):
        for function in (common.code_of, common._code):
            function.cache_clear()
        (tmp_path / "src").mkdir(exist_ok=True)
        (tmp_path / "src" / "a.py").write_text(python, encoding="utf-8")
        (tmp_path / "src" / "a.c").write_text(c, encoding="utf-8")
        return common.code_of("x")

    now = digest("def f():\n    return 1\n", "int a;\n")
    assert (
        digest('# One.\ndef f():\n    """Return 1."""\n\n    return 1\n', "/* a */\nint a;\n")
        == now
    )
    assert digest("def f():\n    return 2\n", "int a;\n") != now
    assert digest("def f():\n    return 1\n", "int b;\n") != now
    assert common.code_of("y") == ""


def test_speeds_of_several_processors_are_the_slowest(results):
    head = "raster,max_error,codec,is_slow,n_samples,encode_speed,decode_speed,processor\n"
    lines = [
        f"{n},1,{codec},False,{n},{write},{read},{processor}\n"
        for processor, n, codec, write, read in (
            ("P", 5000000, "cog", 10, 10), ("P", 5000000, "terrainwave-rapid+", 20, 5),
            ("Q", 5000000, "cog", 10, 10), ("Q", 5000000, "terrainwave-rapid+", 10, 8),
            ("P", 1000000, "cog", 10, 10), ("P", 1000000, "terrainwave-rapid+", 5, 2),
        )
    ]  # fmt: skip
    (results / "speeds.csv").write_text(head + "".join(lines), encoding="utf-8")
    cases = "a,0,{0},int16,{1},\na,1,{0},int16,{1},\n"
    sizes = "raster,max_error,codec,dtype,n_bytes,problem\n"
    (results / "rapid.csv").write_text(
        sizes + cases.format("terrainwave-rapid", 10), encoding="utf-8"
    )
    (results / "peers.csv").write_text(sizes + cases.format("cog", 40), encoding="utf-8")
    ours = tables.side_by_side(results)[0]
    assert (ours["decode lossy / COG"], ours["encode lossy / COG"]) == pytest.approx((0.5, 1.0))
    assert ours["small decode lossy / COG"] == pytest.approx(0.2)


def test_figures_of_sentences_come_from_csvs_or_are_stated(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    monkeypatch.setattr(tables, "STATED", {"page.md": ["30 seconds"]})
    text = """It waits 30 seconds, reads 12 MB/s, <!-- number: x -->7 ms<!-- end --> and `9 ms`.
| 8 ms |

```
5 ms
```
It takes 0.44 of the time, 5 % more.
"""
    (tmp_path / "page.md").write_text(text, encoding="utf-8")
    assert tables.figures_by_hand("page.md") == ["0.44 of", "12 MB/s", "5 %"]


def test_readme_names_every_script_and_every_result():
    folder = tables.ROOT / "benchmarks"
    text = (folder / "README.md").read_text(encoding="utf-8")
    words = {word for quoted in re.findall("`([^`]+)`", text) for word in quoted.split(" ")}
    named = {word.removeprefix("benchmarks.").removesuffix(".py") for word in words}
    assert {path.stem for path in folder.glob("*.py")} - named == {"__init__"}
    for path in (folder / "results").rglob("*.csv"):
        assert any(fnmatch(path.name, word) for word in words), path.name
