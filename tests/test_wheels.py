"""Wheels with the native library and for any platform: what is in them, and which one pip takes."""

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile

import pytest
from native_site import PROJECT, ROOT
from packaging.tags import sys_tags

from terrainwave import __version__, native_sources

NAME = f"terrainwave-{__version__}"
HOOK = runpy.run_path(str(PROJECT / "hatch_build.py"))
full = pytest.mark.full
native = pytest.mark.native


def copied(folder):
    """Copy what git has into a folder, as a clone or an unpacked sdist; return the folder."""
    listed = ["git", "-C", ROOT, "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.check_output(listed, text=True).splitlines():
        is_left_out = name.startswith(("tests/", "benchmarks/", "docs/"))
        is_format = name.startswith(("docs/FORMAT", "docs/format-"))  # for capsules
        if (ROOT / name).is_file() and (is_format or not is_left_out):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


def build(source, target, how, **variables):
    """Let pip build a wheel by what is installed; return the run, and the wheel if there is one."""
    run = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", target,
         source],
        env=os.environ | {"TERRAINWAVE_BUILD": how} | variables,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return run, next(iter(target.glob("*.whl")), None)


def inside(wheel):
    """Return the names in a wheel, the note of its build, and the tags that it states."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        note = json.loads(archive.read("terrainwave/native.json"))
        stated = archive.read(f"{NAME}.dist-info/WHEEL").decode()
    return names, note, re.findall(r"^Tag: (.+)$", stated, re.M)


def libraries(names):
    return [name for name in names if name.endswith((".so", ".dylib", ".dll"))]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """Return the wheel for any platform and that of this one, made of an sdist.

    A library lies beside its package, as after an editable installation.
    """
    folder = tmp_path_factory.mktemp("wheels")
    source = copied(folder / "source")
    (source / "src" / "terrainwave" / native_sources.NAME).write_bytes(b"an older one")
    subprocess.run(
        [sys.executable, "-c", "import sys; from hatchling.build import build_sdist;"
         " build_sdist(sys.argv[1])", folder],
        cwd=source, check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    with tarfile.open(folder / f"{NAME}.tar.gz") as archive:
        archive.extractall(folder, filter="data")
    made = []
    for how in ("none", "require"):
        run, wheel = build(folder / NAME, folder / how, how)
        assert run.returncode == 0, run.stderr
        made.append(wheel)
    return made


@full
@native
def test_one_wheel_has_the_library_and_the_other_says_why_it_has_none(wheels):
    anywhere, here = map(inside, wheels)
    assert libraries(anywhere[0]) == []
    assert anywhere[1].keys() == {"missing"}
    assert anywhere[2] == ["py3-none-any"]
    assert libraries(here[0]) == [f"terrainwave/{native_sources.NAME}"]
    assert here[1] == {"sources": native_sources.digest_of(ROOT)}
    assert here[2] == [f"py3-none-{HOOK['platform_tag'](native_sources.LIBRARY)}"]
    assert set(here[0]) - set(libraries(here[0])) == set(anywhere[0])
    assert [wheel.name.split("-", 2)[2] for wheel in wheels] == [
        "py3-none-any.whl", f"{here[2][0]}.whl",
    ]  # fmt: skip
    assert here[2][0] in map(str, sys_tags())


@full
@native
def test_pip_takes_the_one_that_fits(wheels, tmp_path):
    """The names are those of releases: musl, an old glibc and other processors get the other."""
    for wheel in wheels:
        name = wheel.name.replace("-linux_", "-manylinux_2_34_")
        shutil.copy(wheel, tmp_path / name)
    (machine,) = {tag.platform.split("_", 1)[1] for tag in sys_tags() if "linux_" in tag.platform
                  and tag.platform.startswith("linux_")}  # fmt: skip
    taken = {}
    linux = (f"{kind}_{machine}" for kind in ("manylinux_2_34", "manylinux_2_17", "musllinux_1_2"))
    for platform in (*linux, "manylinux_2_39_ppc64le", "win_amd64"):
        target = tmp_path / platform
        subprocess.run(
            [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-index", "--pre",
             "--only-binary=:all:", "--platform", platform, "--find-links", tmp_path, "--dest",
             target, "terrainwave"],
            check=True,
        )  # fmt: skip
        (found,) = target.iterdir()
        taken[platform] = not found.name.endswith("-any.whl")
    assert [platform for platform, has_library in taken.items() if has_library] == [
        f"manylinux_2_34_{machine}"
    ]


CODE = """
import json, sys
import numpy as np, terrainwave as tw
heights = np.add.outer(np.arange(30), np.arange(20)).astype("int16")
tw.compress(heights, "a.twz", max_error=1)
from terrainwave.capsule import write_capsule
write_capsule("a.twz", "a.zip")
with tw.open("a.twz") as terrain:
    print(json.dumps([terrain.is_native, int(abs(terrain.read() - heights).max())]))
"""


@full
@native
@pytest.mark.parametrize("has_library", [False, True])
def test_an_installed_wheel_compresses_and_reads(wheels, tmp_path, has_library):
    venv.create(tmp_path / "venv", system_site_packages=False, with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    # What it depends on is that of this environment; the package is the wheel's.
    packages = [path for path in sys.path if path.endswith("-packages")]
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target"]
    subprocess.run([*pip, tmp_path / "site", wheels[has_library]], check=True)
    run = subprocess.run(
        [python, "-W", "error", "-c", CODE], cwd=tmp_path, text=True, capture_output=True,
        check=False,
        env=os.environ | {
            "PYTHONPATH": os.pathsep.join([str(tmp_path / "site"), *packages]),
            "TERRAINWAVE_NATIVE": "1",
            "NUMBA_DISABLE_JIT": "1",  # a little: to compile takes longer
        },
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout) == [has_library, 1]


@full
@native
@pytest.mark.parametrize(
    ("how", "told"),
    [
        (
            "require",
            r"found no C compiler \(no-compiler\) on the PATH, expected the native library",
        ),
        ("maybe", "found TERRAINWAVE_BUILD=maybe, expected one of auto, require, none"),
    ],
)
def test_a_build_that_cannot_have_the_library_ends_with_one_line(tmp_path, how, told):
    source = copied(tmp_path / "source")
    run, wheel = build(source, tmp_path, how, CC="no-compiler")
    assert run.returncode != 0
    assert wheel is None
    assert re.search(told, run.stderr)
    assert "Traceback" not in run.stderr


def test_what_the_digest_covers_is_what_the_library_is_built_of(tmp_path):
    """A change of any file that is compiled, or of an annex, makes it another library."""
    source = copied(tmp_path)
    before = native_sources.digest_of(source)
    assert before == native_sources.digest_of(ROOT)
    files = {path.relative_to(source).as_posix() for path in native_sources.source_files(source)}
    assert {"native/src/window.c", "native/src/internal.h", "native/include/terrainwave.h",
            "native/python/shim.c", "src/terrainwave/annexes/rapid.bin"} <= files  # fmt: skip
    for name in sorted(files):
        path = source / name
        data = path.read_bytes()
        path.write_bytes(data + b"\n")
        assert native_sources.digest_of(source) != before, name
        path.write_bytes(data)
    assert native_sources.digest_of(source) == before
    (source / "native" / "src" / "more.c").write_text("int more;\n")
    assert native_sources.digest_of(source) != before
