"""What a measurement depends on besides the code: machine, versions, commit."""

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

PACKAGES = (
    "terrainwave", "numpy", "numba", "scipy", "rasterio", "imagecodecs", "pysz", "xarray", "zarr",
)  # fmt: skip


def describe_machine() -> dict[str, object]:
    """Return machine, versions and commit, ready for JSON; no host name, no paths."""
    import rasterio

    return {
        "processor": _processor(),
        "n_cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "gdal": rasterio.__gdal_version__,
        "packages": {name: _version(name) for name in PACKAGES},
        "commit": _commit(),
    }


def pin_to_one_core() -> bool:
    """Keep this process, and what it starts, on one core; return whether that worked.

    Libraries start threads whether asked to or not, and a comparison at one thread
    must not depend on which of them do.
    """
    if not hasattr(os, "sched_setaffinity"):
        return False
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    return True


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor()


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Return the commit of this checkout, with "+" if tracked files were changed."""
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        commit = subprocess.check_output(
            [*git, "rev-parse", "--short=12", "HEAD"],
            text=True,
            stderr=subprocess.DEVNULL,
        ).strip()
        changed = subprocess.check_output(
            [*git, "status", "--porcelain", "--untracked-files=no"], text=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + ("+" if changed else "")
