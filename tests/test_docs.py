"""Do the site, its snippets and its notebooks work as they are printed?"""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from strategies import write_geotiff

from terrainwave.cli import main

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [DOCS / "index.md", *sorted((DOCS / "how-to").glob("*.md"))]
TESTS_PAGE = ROOT / "tests" / "README.md"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page, *languages):
    found = _BLOCK.findall(page.read_text(encoding="utf-8"))
    return [(language, text) for language, text in found if language in languages]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where snippets run: `dem.tif` and what `compress` makes of it."""
    rows, cols = np.mgrid[:280, :290]
    heights = (500 + rows + 40 * np.sin(cols / 19) + 3 * np.sin(rows * cols / 70)).astype(
        np.float32
    )
    write_geotiff(tmp_path / "dem.tif", heights)
    monkeypatch.chdir(tmp_path)
    assert run("terrainwave compress dem.tif dem.twz --max-error 0.25").exit_code == 0
    return tmp_path


def run(line):
    program, *arguments = shlex.split(line, comments=True)
    assert program == "terrainwave"
    return CliRunner().invoke(main, arguments)


@pytest.mark.few(5)
@pytest.mark.large
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_snippets_run_in_the_order_of_the_page(page, folder):
    names = {}
    for language, text in blocks(page, "python", "sh"):
        if language == "python":
            exec(compile(text, page.name, "exec"), names)
            continue
        for line in filter(None, text.splitlines()):
            overwrites = re.match(r"terrainwave (compress|decompress|mesh) ", line)
            found = run(line + " --overwrite" * bool(overwrites))
            assert found.exit_code == 0, f"{line}: {found.output}"


def test_commands_that_are_only_shown_exist():
    """``` without a language: pip, windows, servers."""
    for page in PAGES:
        for _, text in blocks(page, ""):
            for name in re.findall(r"^terrainwave (\w+)", text, re.MULTILINE):
                assert name in main.commands, f"{page.name}: terrainwave {name}"


@pytest.mark.full
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path, tmp_path):
    import nbformat  # here: it takes six seconds, of each worker
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "clear its outputs"
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()


def test_every_page_has_a_place_in_the_site():
    """MkDocs builds the others too, but nobody finds them."""
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[1]
    assert sorted(re.findall(r"[\w/-]+\.md", nav)) == sorted(pages)


@pytest.mark.full
def test_the_site_builds_without_a_warning(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", tmp_path / "site"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "site" / "api" / "index.html").read_text(encoding="utf-8")
    assert "Instead of <code>window</code>" in page  # a docstring came through
    pages = (tmp_path / "site").rglob("*.html")
    assert all("fonts.googleapis" not in text.read_text(encoding="utf-8") for text in pages)


@pytest.mark.parametrize("page", [ROOT / "CONTRIBUTING.md", TESTS_PAGE], ids=lambda page: page.stem)
def test_files_that_pages_for_contributors_name_exist(page):
    text = page.read_text(encoding="utf-8")
    links = [page.parent / link for link in re.findall(r"\]\(([\w./-]+)", text)]
    named = [
        ROOT / name for name in re.findall(r"`((?:docs|tests|tools|\.github)/[\w./-]+)`", text)
    ]
    assert links + named
    for path in links + named:
        assert path.exists() or "…" in path.name, path


def test_marks_of_the_table_are_those_that_tests_may_have():
    """All but `kernels` and `files`, which conftest gives."""
    options = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    markers = {
        line.partition(":")[0] for line in options["tool"]["pytest"]["ini_options"]["markers"]
    }
    named = re.findall(
        r"^\| `@pytest\.mark\.(\w+)` \|", TESTS_PAGE.read_text(encoding="utf-8"), re.M
    )
    assert sorted(named) == sorted(markers - {"kernels", "files"})
