"""Programs that PyInstaller makes of the package find what is imported by name."""

import os
import runpy
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from terrainwave.ext import pyinstaller
from terrainwave.names import METHODS

pytest.importorskip("PyInstaller")

(HOOKS,) = pyinstaller.hook_dirs()
PROGRAM = """
import numpy as np, terrainwave as tw
if __name__ == "__main__":
    tw.compress(np.arange(90000.0).reshape(300, 300), "a.twz", max_error=0.5, overwrite=True)
    print(tw.open("a.twz").read().shape)
"""
# They are in the environment of the tests, and take minutes.
OTHERS = (
    "matplotlib scipy IPython jupyterlab pyvista vtkmodules dask xarray selenium pytest".split()
)


def test_the_hook_names_all_codecs():
    hidden = runpy.run_path(Path(HOOKS) / "hook-terrainwave.py")["hiddenimports"]
    assert {f"terrainwave.codec.{method}.refiner" for method in METHODS} <= set(hidden)


def test_pyinstaller_finds_the_hook():
    found = entry_points(group="pyinstaller40")
    assert "terrainwave.ext.pyinstaller:hook_dirs" in {one.value for one in found}


@pytest.mark.full
def test_a_program_compresses_and_reads(tmp_path):
    (tmp_path / "app.py").write_text(PROGRAM)
    excluded = [word for name in OTHERS for word in ("--exclude-module", name)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    words = ["--noconfirm", "--onedir", "--log-level", "WARN", "--additional-hooks-dir", HOOKS]
    subprocess.run(
        [sys.executable, "-m", "PyInstaller", *words, *excluded, "app.py"],
        cwd=tmp_path, env=environment, check=True, timeout=1200,
    )  # fmt: skip
    environment.pop("PYTHONPATH")
    done = subprocess.run(
        [tmp_path / "dist" / "app" / "app"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "(300, 300)\n", "")
