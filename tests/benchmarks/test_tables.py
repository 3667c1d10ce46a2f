"""Do documents get the tables and the numbers of sentences that their CSVs have?"""

import re
from fnmatch import fnmatch

import pytest

from benchmarks import tables

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


def test_readme_names_every_script_and_every_result():
    folder = tables.ROOT / "benchmarks"
    text = (folder / "README.md").read_text(encoding="utf-8")
    words = {word for quoted in re.findall("`([^`]+)`", text) for word in quoted.split(" ")}
    named = {word.removeprefix("benchmarks.").removesuffix(".py") for word in words}
    assert {path.stem for path in folder.glob("*.py")} - named == {"__init__"}
    for path in (folder / "results").rglob("*.csv"):
        assert any(fnmatch(path.name, word) for word in words), path.name
