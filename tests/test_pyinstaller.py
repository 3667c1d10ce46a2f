"""Programs that PyInstaller makes of the package find what is imported by name."""

import os
import re
import runpy
import subprocess
import sys
from importlib.metadata import entry_points, packages_distributions, requires
from pathlib import Path

import numpy as np
import pytest

import terrainwave
from terrainwave.ext import pyinstaller
from terrainwave.names import METHODS

pytest.importorskip("PyInstaller")

(HOOKS,) = pyinstaller.hook_dirs()
PROGRAM = """
import sys, terrainwave as tw
if __name__ == "__main__":
    for name in sys.argv[1:]:
        print(name, tw.open(name).read().sum())
"""


def test_the_hook_names_all_codecs():
    hidden = runpy.run_path(Path(HOOKS) / "hook-terrainwave.py")["hiddenimports"]
    assert {f"terrainwave.codec.{method}.refiner" for method in METHODS} <= set(hidden)


def test_pyinstaller_finds_the_hook():
    found = entry_points(group="pyinstaller40")
    assert "terrainwave.ext.pyinstaller:hook_dirs" in {one.value for one in found}


def needed(distribution: str, found: set[str]) -> set[str]:
    """Add a distribution and what it needs without extras to `found`; return `found`."""
    if distribution not in found:
        found.add(distribution)
        for line in requires(distribution) or ():
            if "extra ==" not in line and "sys_platform" not in line:
                needed(re.split(r"[^\w.-]", line)[0].lower(), found)
    return found


def not_needed() -> list[str]:
    """Return packages of this environment that no installation without extras has.

    numba and rasterio import some of them if they find them, which takes PyInstaller minutes.
    """
    kept = needed("terrainwave", set())
    # The program prints no tables.
    return ["tkinter", "rich", "pygments", *(
        name for name, those in packages_distributions().items()
        if not kept & {one.lower() for one in those}
    )]  # fmt: skip


@pytest.mark.full
def test_a_program_reads_files_of_all_codecs(tmp_path):
    heights = np.arange(340, dtype="int16").reshape(20, 17)
    names = [f"{method}.twz" for method in METHODS]
    for method in METHODS:
        terrainwave.compress(heights, tmp_path / f"{method}.twz", max_error=0, method=method)
    (tmp_path / "app.py").write_text(PROGRAM)
    excluded = [word for name in not_needed() for word in ("--exclude-module", name)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    words = ["--noconfirm", "--onedir", "--log-level", "WARN", "--additional-hooks-dir", HOOKS]
    subprocess.run(
        [sys.executable, "-m", "PyInstaller", *words, *excluded, "app.py"],
        cwd=tmp_path, env=environment, check=True, timeout=1200,
    )  # fmt: skip
    environment.pop("PYTHONPATH")
    # To compile the kernels of all codecs takes a minute.
    for those, kernels in ((names, {"NUMBA_DISABLE_JIT": "1"}), (["store.twz"], {})):
        done = subprocess.run(
            [tmp_path / "dist" / "app" / "app", *those],
            cwd=tmp_path, env=environment | kernels, capture_output=True, text=True, timeout=600,
        )  # fmt: skip
        expected = "".join(f"{name} {heights.sum()}\n" for name in those)
        assert (done.returncode, done.stdout, done.stderr) == (0, expected, "")
