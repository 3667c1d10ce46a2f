"""What workflows and hooks run: names that there are. Whether they pass is for machines to say."""

import re
import tomllib
from pathlib import Path

import yaml
from _pytest.mark.expression import Expression

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")


def lines_run():
    """Yield the name of a job, its shell and the lines of each of its steps."""
    for path in sorted((ROOT / ".github" / "workflows").glob("*.yml")):
        jobs = yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
        for name, job in jobs.items():
            shell = job.get("defaults", {}).get("run", {}).get("shell", "bash")
            for step in job["steps"]:
                if "run" in step:
                    yield f"{path.stem}-{name}", shell, re.sub(r"\$\{\{.*?\}\}", "X", step["run"])
    yield "ci-run", "bash", (ROOT / ".ci" / "run").read_text(encoding="utf-8")


LINES = list(lines_run())


def test_targets_of_make_are_in_the_makefile():
    for _, _, text in LINES:
        for words in re.findall(r"^\s*make ([\w -]+)$", text, re.MULTILINE):
            for target in words.split():
                assert re.search(rf"^[\w -]*\b{target}\b[\w -]*:", MAKEFILE, re.MULTILINE), target


def test_files_that_are_named_are_there():
    for _, _, text in LINES:
        named = re.findall(
            r"(?:^|[\s\"'])((?:tests|native|src|docs)(?:[/\\][\w.-]+)*)", text, re.MULTILINE
        )
        for name in named:
            assert (ROOT / name.replace("\\", "/")).exists(), name


def test_pytest_is_given_marks_that_there_are():
    markers = PROJECT["tool"]["pytest"]["ini_options"]["markers"]
    marks = {line.partition(":")[0] for line in markers}
    for _, _, text in LINES:
        for quoted, plain in re.findall(r"pytest\b.* -m (?:\"([^\"]+)\"|(\w+))", text):
            names = set(re.findall(r"\w+", quoted or plain)) - {"not", "and", "or"}
            assert names <= marks
            Expression.compile(quoted or plain)


def test_extras_that_are_installed_are_those_of_the_project():
    for _, _, text in LINES:
        for names in re.findall(r"pip install .*\"\.\[([\w,]+)\]\"", text):
            assert set(names.split(",")) <= PROJECT["project"]["optional-dependencies"].keys()


def test_hooks_run_what_make_lint_does():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    (repository,) = hooks["repos"]
    entries = {hook["entry"].removeprefix(".venv/bin/") for hook in repository["hooks"]}
    lint = MAKEFILE.split("\nlint:")[1].split("\n\n")[0]
    commands = re.findall(r"\$\(BIN\)/(.+)", lint)
    assert entries == {command.replace(" --check", "").removesuffix(" .") for command in commands}
