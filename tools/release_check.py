"""A release as its users get it: built, looked at, installed in fresh environments, and used.

Makes the sdist, the wheel with the native library and the wheel for any platform into ``dist/``,
makes them once more from a copy of what git has, and compares the bytes. Then installs the wheel
that pip takes here alone, with each extra, and with all of them in their newest and in the lowest
versions that pyproject.toml allows, and the wheel for any platform alone; and runs there the
commands and the Python of the README and of the quick start, in an empty folder with a small
raster. What is not installed must be asked for by one line that names the extra.
"""

import functools
import os
import re
import shutil
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import zipfile
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import rasterio
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from benchmarks.common import ROOT, ListOption, command, option, write_rows
from terrainwave import native_sources
from tools.release_uses import TYPED, USES

DOCUMENTS = ("README.md", "docs/index.md")
# What developers install.
NOT_FOR_USERS = {"bench", "fuzz", "release", "docs", "dev"}
TESTS = ("tests/test_terrain.py", "tests/test_golden.py", "tests/codec", "tests/cli")
TEST_PACKAGES = ("pytest", "hypothesis", "scipy")
_PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT, WHEEL = _PYPROJECT["project"], _PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]
EXTRAS = [name for name in PROJECT["optional-dependencies"] if name not in NOT_FOR_USERS]
ENVIRONMENTS = ["core", "any", *EXTRAS, "newest", "lowest"]

Built = namedtuple("Built", "file n_files n_bytes same_again")
Row = namedtuple(
    "Row", "environment python n_packages versions commands ran asked failed asked_for uses used"
    " import_ms tests_passed tests_failed problems",
)  # fmt: skip
# A command of a document and how it ended: "ran", "failed", or the extra it asked for.
Ended = namedtuple("Ended", "line outcome last")


# --- sdist and wheels ---


def build(source: Path, target: Path) -> list[Path]:
    """Make the sdist, and both wheels from it, of the time of the last commit; return all.

    auditwheel names the wheel with the library after the oldest glibc that has what it needs.
    """
    stamp = subprocess.check_output(["git", "-C", ROOT, "log", "-1", "--format=%ct"], text=True)
    # Programs of this environment first: cmake is one of them.
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    variables = os.environ | {"SOURCE_DATE_EPOCH": stamp.strip(), "PATH": path}

    def run(*words: str | Path, how: str = "none") -> None:
        subprocess.run(
            [sys.executable, "-m", *words], env=variables | {"TERRAINWAVE_BUILD": how}, check=True,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip

    build = ("build", "--no-isolation")
    run(*build, "--sdist", "--outdir", target, source)
    (sdist,) = target.glob("terrainwave-*.tar.gz")
    with tempfile.TemporaryDirectory() as name:
        unpacked, folder = unpack(sdist, Path(name)), Path(name) / "wheels"
        run(*build, "--wheel", "--outdir", target, unpacked)
        run(*build, "--wheel", "--outdir", folder, unpacked, how="require")
        (wheel,) = folder.glob("*.whl")
        if sys.platform == "linux":
            run("auditwheel", "repair", "--patcher", "none", "--wheel-dir", target, wheel)
        else:
            shutil.copy(wheel, target)
    return sorted(target.glob("terrainwave-*"))


def kind_of(name: str) -> str:
    """Return "sdist", "any" for the wheel for any platform, "here" for that of this one."""
    if name.endswith(".tar.gz"):
        return "sdist"
    return "any" if name.endswith("-any.whl") else "here"


def unpack(sdist: Path, folder: Path) -> Path:
    """Return the folder that an sdist unpacks to."""
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    return folder / sdist.name.removesuffix(".tar.gz")


def contents(path: Path) -> set[str]:
    """Return the names of files in an sdist, less its folder, or in a wheel."""
    if path.suffix == ".whl":
        # auditwheel lists folders, too.
        return {name for name in zipfile.ZipFile(path).namelist() if not name.endswith("/")}
    with tarfile.open(path) as archive:
        return {member.name.split("/", 1)[1] for member in archive if member.isfile()}


def expected_contents(path: Path) -> set[str]:
    """Return what belongs into the sdist or a wheel: what git has, the library, its note."""
    listed = subprocess.check_output(["git", "-C", ROOT, "ls-files"], text=True).splitlines()
    about = f"terrainwave-{version()}.dist-info"
    licences = {f"licenses/{name}" for name in PROJECT["license-files"]}
    generated = {"METADATA", "RECORD", "WHEEL", "entry_points.txt"}
    wheel = {f"{about}/{name}" for name in licences | generated} | {"terrainwave/native.json"}
    if not path.name.endswith("-any.whl"):
        wheel.add(f"terrainwave/{native_sources.NAME}")
    wheel.update(WHEEL["force-include"].values())
    for name in listed:
        if any(f"{name}/".startswith(f"{part}/") for part in WHEEL["only-include"]):
            source = next(part for part in WHEEL["sources"] if name.startswith(f"{part}/"))
            wheel.add(WHEEL["sources"][source] + name.removeprefix(source))
    return wheel if path.suffix == ".whl" else {*listed, "PKG-INFO"}


def version() -> str:
    """Return the version that the sources state."""
    text = (ROOT / "src/terrainwave/_version.py").read_text(encoding="utf-8")
    return re.search(r'__version__ = "(.+)"', text)[1]  # type: ignore[index]


def built_twice(folder: Path) -> Iterator[Built]:
    """Make sdist and wheels into ``dist/``; say of each if a copy of what git has makes the same.

    Raises
    ------
    ClickException
        If twine objects, a file is missing or does not belong there.
    """
    target = ROOT / "dist"
    for old in target.glob("terrainwave-*"):
        old.unlink()
    made = build(ROOT, target)
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *made], check=True)
    copy = folder / "copy"
    copy.mkdir()
    # With what is changed and not committed, if anything is: `git stash create` names that.
    changed = subprocess.check_output(["git", "-C", ROOT, "stash", "create"], text=True).strip()
    archive = ["git", "-C", ROOT, "archive", "--output", folder / "copy.tar", changed or "HEAD"]
    subprocess.run(archive, check=True)
    with tarfile.open(folder / "copy.tar") as packed:
        packed.extractall(copy, filter="data")
    again = build(copy, folder / "again")
    for path, other in zip(made, again, strict=True):
        found, expected = contents(path), expected_contents(path)
        if found != expected:
            different = ", ".join(sorted(found ^ expected)[:8])
            raise click.ClickException(f"{path.name} and git do not have the same: {different}")
        same = path.read_bytes() == other.read_bytes()
        yield Built(path.name, len(found), path.stat().st_size, same)


# --- environments ---


def lower_bounds(requirements: list[str]) -> dict[str, str]:
    """Return the lowest version of each package that all requirements allow."""
    found: dict[str, str] = {}
    for requirement in map(Requirement, requirements):
        (bound,) = (spec.version for spec in requirement.specifier if spec.operator == ">=")
        found[requirement.name] = max(bound, found.get(requirement.name, "0"), key=Version)
    return found


def requirements_of(extras: list[str]) -> list[str]:
    """Return what the package and these extras require."""
    optional = PROJECT["optional-dependencies"]
    return [*PROJECT["dependencies"], *(name for extra in extras for name in optional[extra])]


def extras_of(environment: str) -> list[str]:
    """Return the extras that are installed there."""
    if environment in EXTRAS:
        return [environment]
    return [] if environment in ("core", "any") else EXTRAS


class Environment:
    """A fresh virtual environment with the wheel, its extras and nothing else."""

    def __init__(self, name: str, python: str, wheel: Path, folder: Path) -> None:
        # All at one place, one after the other: numba's cache knows kernels by their path.
        self.name, self.folder = name, folder / "venv"
        subprocess.run([python, "-m", "venv", "--clear", self.folder], check=True)
        extras = extras_of(name)
        self.limits: list[str | Path] = []
        if name == "lowest":
            bounds = lower_bounds(requirements_of(extras))
            limits = folder / "lowest.txt"
            limits.write_text("".join(f"{package}=={least}\n" for package, least in bounds.items()))
            self.limits = ["--constraint", limits]
        named = f"{wheel}[{','.join(extras)}]" if extras else str(wheel)
        self.install(named)

    def install(self, *arguments: str | Path) -> None:
        """Install packages, in their newest versions that the environment allows."""
        pip = [
            self.folder / "bin" / "python",
            "-m",
            "pip",
            "--disable-pip-version-check",
            "install",
        ]
        subprocess.run([*pip, "--quiet", "--upgrade", *self.limits, *arguments], check=True)

    def run(self, line: str, folder: Path, seconds: float = 900) -> subprocess.CompletedProcess:
        """Run a line of a shell with this environment's programs and none of its caller's."""
        hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
        variables = {key: value for key, value in os.environ.items() if key not in hidden}
        path = f"{self.folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
        cache = str(self.folder.parent / "numba")
        # An end after so many seconds is a failure as any other.
        return subprocess.run(
            ["timeout", str(seconds), "bash", "-c", line],
            cwd=folder, capture_output=True, text=True, check=False,
            env=variables | {"PATH": path, "NUMBA_CACHE_DIR": cache},
        )  # fmt: skip

    def packages(self) -> dict[str, str]:
        """Return the version of every package, but pip's and setuptools'."""
        lines = self.run("python -m pip list --format freeze", self.folder).stdout.splitlines()
        pairs = (line.split("==") for line in lines)
        return {name: found for name, found in pairs if name not in ("pip", "setuptools")}


def milliseconds_of_import(environment: Environment) -> float:
    """Return by how much `import terrainwave` makes an interpreter's start longer: medians of 9."""
    seconds: dict[str, list[float]] = {"pass": [], "import terrainwave": []}
    for _ in range(9):
        for code, found in seconds.items():
            start = time.perf_counter()
            environment.run(f"python -c '{code}'", environment.folder)
            found.append(time.perf_counter() - start)
    bare, whole = (statistics.median(found) for found in seconds.values())
    return round(1000 * (whole - bare), 1)


# --- what documents say ---


def documented(document: str) -> Iterator[tuple[str, str]]:
    """Yield what a document says in its order: ("sh", a line) or ("python", a block).

    A line that comes again is left out: what it makes is there.
    """
    text = (ROOT / document).read_text(encoding="utf-8")
    seen: set[str] = set()
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        if language == "python":
            yield "python", block
        elif language in ("", "sh", "bash", "console"):
            for line in block.replace("\\\n", " ").splitlines():
                command = line.removeprefix("$ ").split("  #")[0].strip()
                if command.startswith("terrainwave ") and command not in seen:
                    seen.add(command)
                    yield "sh", command


def make_rasters(folder: Path) -> None:
    """Write the rasters that documents name: hills in UTM zone 33, a newer part, two neighbours."""
    rows, cols = np.mgrid[:280, :290]
    heights = 500 + rows + 40 * np.sin(cols / 19) + 3 * np.sin(rows * cols / 70)
    parts = {
        "dem": (heights, 0, 0),
        "newer": (heights[50:120, 60:200] + 7, 50, 60),
        "dems/west": (heights[:, :150], 0, 0),
        "dems/east": (heights[:, 140:], 0, 140),
    }
    (folder / "dems").mkdir(parents=True)
    for name, (part, row, col) in parts.items():
        place = rasterio.Affine(30, 0, 500_000 + 30 * col, 0, -30, 5_000_000 - 30 * row)
        with rasterio.open(
            folder / f"{name}.tif", "w", driver="GTiff", count=1, dtype="float32", crs="EPSG:32633",
            height=part.shape[0], width=part.shape[1], transform=place,
        ) as dataset:  # fmt: skip
            dataset.units = ("m",)
            dataset.write(part.astype(np.float32), 1)


# These go on until they are stopped: the server once it has answered, the window once it is there.
# set -m: what a shell starts in the background would ignore Ctrl-C.
SERVED = """
set -m
{line} --port 0 > served.txt & pid=$!
for _ in $(seq 600); do
    grep -q http served.txt && break
    kill -0 $pid 2> /dev/null || break
    sleep 0.2
done
address=$(grep -o 'http[^ ]*' served.txt) &&
    python -c "import sys, urllib.request as u; u.urlopen(sys.argv[1]).read(9)" $address
answered=$?
kill -INT $pid 2> /dev/null
wait $pid
exit $(( $? + answered ))
"""
VIEWED = """
{line} & pid=$!
for _ in $(seq 600); do
    xdotool search --onlyvisible --name terrainwave > /dev/null 2>&1 && break
    kill -0 $pid 2> /dev/null || break
    sleep 0.2
done
xdotool search --onlyvisible --name terrainwave key Escape 2> /dev/null
wait $pid
"""


def ended(environment: Environment, kind: str, text: str, folder: Path) -> Ended:
    """Run what a document says, and tell how it ended."""
    if kind == "python":
        (folder / "block.py").write_text(text, encoding="utf-8")
        line, run = "Python", "python block.py"
    else:
        line = run = text
        if text.startswith("terrainwave serve "):
            run = SERVED.format(line=text)
        elif text.startswith("terrainwave view "):
            (folder / "view.sh").write_text(VIEWED.format(line=text), encoding="utf-8")
            run = "xvfb-run -a bash view.sh"
    done = environment.run(run, folder)
    lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
    last = lines[-1] if lines else ""
    if done.returncode == 0:
        return Ended(line, "ran", last)
    # A server's line is followed by the shell's.
    wanted = re.search(r'needs .*: pip install "terrainwave\[(\w+)\]"', done.stderr)
    asks = wanted and wanted[1] not in extras_of(environment.name)
    return Ended(line, wanted[1] if wanted and asks else "failed", last)


def used(environment: Environment, folder: Path) -> list[Ended]:
    """Use each extra that is installed for what it is there for."""
    found = []
    with_library = [] if environment.name == "any" else ["library"]
    for extra in ["core", *with_library, *extras_of(environment.name)]:
        (folder / "use.py").write_text(USES[extra], encoding="utf-8")
        done = environment.run("python use.py", folder)
        lines = done.stderr.strip().splitlines()
        outcome = "ran" if done.returncode == 0 else "failed"
        found.append(Ended(f"use of {extra}", outcome, lines[-1] if lines else ""))
    return found


def typed(environment: Environment, folder: Path) -> Ended:
    """Check types of a user's script with mypy: one that is right, and one that is wrong."""
    environment.install("mypy")
    (folder / "typed.py").write_text(TYPED, encoding="utf-8")
    done = environment.run("python -m mypy --strict typed.py", folder)
    errors = [line for line in done.stdout.splitlines() if ": error:" in line]
    wrong = 1 + TYPED.splitlines().index("heights: str = terrain.read()")
    is_right = len(errors) == 1 and errors[0].startswith(f"typed.py:{wrong}: ")
    return Ended("mypy", "ran" if is_right else "failed", done.stdout.strip()[-300:])


def tested(environment: Environment, sdist: Path, folder: Path) -> tuple[int, int]:
    """Run tests of the unpacked sdist on the installed wheel; return how many passed and failed."""
    environment.install(*TEST_PACKAGES)
    source = unpack(sdist, folder)
    # Not `src`, as pyproject.toml has it: the wheel is tested. Old packages warn of newer ones.
    done = environment.run(
        "python -m pytest -q -m 'not (full or slow_compile)' -o pythonpath='tests .'"
        f" -p no:cacheprovider -W ignore::DeprecationWarning {' '.join(TESTS)}",
        source, seconds=3600,
    )  # fmt: skip
    click.echo("\n".join(done.stdout.splitlines()[-15:]))
    counts = {
        word: int(number)
        for number, word in re.findall(r"(\d+) (passed|failed|error)", done.stdout.splitlines()[-1])
    }
    return counts.get("passed", 0), counts.get("failed", 0) + counts.get("error", 0)


# --- all of it ---


def check(name: str, python: str, dist: dict[str, Path], folder: Path, *, tests: bool) -> Row:
    """Make an environment, and do there what its row of the CSV says."""
    click.echo(f"{name} ...")
    environment = Environment(name, python, dist["any" if name == "any" else "here"], folder)
    packages = environment.packages()
    ends: list[Ended] = []
    for document in DOCUMENTS:
        place = folder / name / Path(document).stem
        make_rasters(place)
        ends += [ended(environment, kind, text, place) for kind, text in documented(document)]
    uses = used(environment, place)
    speed = milliseconds_of_import(environment)
    if name == "core":
        uses.append(typed(environment, place))
    passed = failed = ""
    if tests and name in ("newest", "lowest"):
        passed, failed = map(str, tested(environment, dist["sdist"], folder / name))
    outcomes = [end.outcome for end in ends]
    asked = sorted(set(outcomes) - {"ran", "failed"})
    named = {canonicalize_name(Requirement(text).name) for text in requirements_of(extras_of(name))}
    shown = environment.run("python -c 'import platform; print(platform.python_version())'", folder)
    return Row(
        environment=name,
        python=shown.stdout.strip(),
        n_packages=len(packages),
        versions="; ".join(
            f"{key} {found}" for key, found in packages.items() if canonicalize_name(key) in named
        ),
        commands=len(ends),
        ran=outcomes.count("ran"),
        asked=sum(map(outcomes.count, asked)),
        failed=outcomes.count("failed"),
        asked_for=" ".join(asked),
        uses=len(uses),
        used=sum(use.outcome == "ran" for use in uses),
        import_ms=speed,
        tests_passed=passed,
        tests_failed=failed,
        problems=" | ".join(f"{e.line}: {e.last}" for e in ends + uses if e.outcome == "failed"),
    )


@command("release.csv")
@option("--only", cls=ListOption, type=click.Choice(ENVIRONMENTS), default=ENVIRONMENTS)
@option("--python", default=sys.executable, show_default="this one", help="Of the environments.")
@option("--tests", is_flag=True, help="Run tests too, in the newest and the lowest.")
@option("--append", is_flag=True, help="Keep the rows that are there.")
def main(
    out: Path, folder: Path, only: tuple[str, ...], python: str, tests: bool, append: bool
) -> None:
    """Build, install, use; exit 1 if anything failed."""
    files = write_rows(out.with_name(f"{out.stem}_files.csv"), built_twice(folder))
    dist = {kind_of(row.file): ROOT / "dist" / row.file for row in files}
    sbom = ROOT / "build" / "terrainwave.cdx.json"
    sbom.parent.mkdir(exist_ok=True)
    subprocess.run([sys.executable, ROOT / "tools/make_sbom.py", sbom, *dist.values()], check=True)
    do = functools.partial(check, python=python, dist=dist, folder=folder, tests=tests)
    rows = write_rows(out, (do(name) for name in only), append=append)
    is_bad = any(row.problems or row.tests_failed not in ("", "0") for row in rows)
    raise SystemExit(is_bad or not all(row.same_again for row in files))


if __name__ == "__main__":
    main()
