"""What holds for every test: errors of numpy, examples of hypothesis, markers, no skips in CI."""

import gc
import importlib.util
import os
import shutil
import sys
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from native_site import can_build, is_built, library, way, with_library  # noqa: F401  fixtures

from terrainwave.coding.jit import all_compiled

# What is tested is Python's codecs; tests of the native library switch it on, and those of
# BOTH_WAYS run with it, too.
os.environ["TERRAINWAVE_NATIVE"] = "0"

# A silent overflow in an encoder is a broken bound in a file.
np.seterr(all="raise")

TESTS = Path(__file__).parent
IN_CI = os.environ.get("CI", "").lower() in {"1", "true"}
WITHOUT_JIT = os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}

# The same examples on each run and machine. No deadline and no "too slow": the first
# example compiles kernels, which takes seconds.
_COMMON = settings(
    derandomize=True,
    deadline=None,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
# `make test-all` draws full ones, of what `make test` has drawn fast (--hypothesis-profile=full).
settings.register_profile("full", _COMMON, max_examples=30)
settings.register_profile("fast", _COMMON, max_examples=10)
settings.load_profile("fast")

# Tests in which no kernel of ours does what is tested, or C does: they run once, compiled. All
# others are marked `kernels`.
WITHOUT_KERNELS = {
    "benchmarks", "capsule", "cli", "container", "ext", "gdal_driver", "place", "raster_io",
    "test_annexes.py", "test_archive.py", "test_architecture.py", "test_arguments.py",
    "test_cache.py", "test_camera.py", "test_compiler.py", "test_controls.py",
    "test_convert_in_c.py", "test_crew.py", "test_dispatchers.py", "test_docs.py",
    "test_examples.py", "test_extras.py", "test_faults.py", "test_format_example.py",
    "test_javascript_kernels.py", "test_jit.py", "test_kernel_cache.py",
    "test_logging.py", "test_masks_in_c.py", "test_mime.py", "test_native.py",
    "test_polynomials.py", "test_pyinstaller.py",
    "test_release.py", "test_types.py", "test_units_in_c.py", "test_wheels.py", "test_window.py",
    "test_workflows.py",
}  # fmt: skip
# Tests of whole files or pictures, marked `files` and `large`: what their kernels compute has tests
# of its own. The others with kernels run with bounds checked, and as plain Python unless they are
# `large`.
OF_FILES = {
    "export", "globe", "write", "test_batched.py", "test_beginnings.py", "test_captions.py",
    "test_coefficients.py", "test_colors.py", "test_determinism.py",
    "test_front_pixels.py", "test_lods.py", "test_loose.py", "test_names.py", "test_pixels.py",
    "test_read_ahead.py", "test_salvage.py", "test_solid.py", "test_terrain.py",
    "test_unmeasured.py", "test_voids.py", "test_water.py",
}  # fmt: skip
# Tests of the main paths: they run without the native library, and once more with it.
BOTH_WAYS = {"test_terrain.py", "test_guarantee.py", "verification/test_verify.py"}
# The longest of all. Then one worker compiles the codecs, while the other one compiles meshes and
# starts processes: or both would compile the same.
FIRST = (
    "test_containers.py", "test_warmup.py", "test_pyinstaller.py",
    "test_wheels.py", "test_javascript_kernels.py", "test_jupyter.py", "test_types.py",
    "test_reference_decoder.py", "tri", "coding", "test_extras.py", "test_architecture.py",
)  # fmt: skip


def pytest_configure(config):
    """Compile rare kernels, too.

    Workers that need the same kernel at one time each compile it: to wait for one another, by a
    lock for each kernel, took as much processor time in all (tests of codec and tri), and waiting.
    """
    all_compiled().__enter__()


def pytest_report_header(config):
    """Say which kernels the tests run, and whether those that need OpenGL do."""
    bounds = os.environ.get("NUMBA_BOUNDSCHECK", "0") not in {"", "0"}
    kernels = "plain Python" if WITHOUT_JIT else "compiled"
    checked = ", bounds checked" if bounds else ""
    return f"kernels: {kernels}{checked}; tests with OpenGL: {_why_no_gl() or 'yes'}"


def _why_no_gl() -> str:
    """Return why tests marked `gl` cannot run; empty if they can be tried."""
    if os.environ.get("TERRAINWAVE_GL", "1") == "0":
        return "left out, TERRAINWAVE_GL=0"
    if importlib.util.find_spec("moderngl") is None:
        return "left out, moderngl is not installed"
    return ""


def _lacks_qgis() -> bool:
    """Say whether QGIS's Python is not there and cannot be installed as our targets do."""
    has_qgis = Path("/usr/lib/python3/dist-packages/qgis/core").exists()
    return not has_qgis and shutil.which("apt-get") is None


def _lacks_gdal() -> bool:
    """Say whether the system's GDAL is not there and cannot be installed as our targets do."""
    return shutil.which("gdal-config") is None and shutil.which("apt-get") is None


def _lacks_compilers() -> bool:
    """Say whether the native library cannot be built as our targets do, or was never tried here."""
    has_none = not can_build() and shutil.which("apt-get") is None
    return sys.platform != "linux" or has_none


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Look for no cycles while files are imported, nor in what they made: a third of that time."""
    gc.disable()
    found = yield
    gc.freeze()
    gc.enable()
    return found


def pytest_ignore_collect(collection_path, config):
    """Import no file of which the marks of test-bounds and test-python leave out all."""
    if config.getoption("markexpr").startswith("kernels and not"):
        parts = collection_path.relative_to(TESTS).parts
        return not (WITHOUT_KERNELS | OF_FILES).isdisjoint(parts) or None
    return None


def pytest_generate_tests(metafunc):
    """Run tests of the main paths both ways."""
    if Path(metafunc.module.__file__).relative_to(TESTS).as_posix() in BOTH_WAYS:
        metafunc.fixturenames.append("way")
        ways = ["numba", pytest.param("c", marks=pytest.mark.native)]
        metafunc.parametrize("way", ways, indirect=True)


def pytest_collection_modifyitems(config, items):
    """Mark what holds kernels, sort files; leave out what needs what cannot be had here."""
    _leave_to_full(items)
    n_tests = Counter(item.path for item in items)
    for item in items:
        parts = item.path.relative_to(TESTS).parts
        is_by_c = getattr(item, "callspec", None) and item.callspec.params.get("way") == "c"
        if WITHOUT_KERNELS.isdisjoint(parts) and not is_by_c:
            item.add_marker("kernels")
        if not OF_FILES.isdisjoint(parts):
            item.add_marker("large")
            item.add_marker("files")
    # Then files of many tests before those of few, so that workers end together.
    items.sort(key=lambda item: (_turn(item.path), -n_tests[item.path]))
    missing = {
        "gl": bool(_why_no_gl()),
        "qgis": _lacks_qgis(),
        "firefox": shutil.which("firefox-esr") is None,  # Ubuntu has no such package
        "gdal": _lacks_gdal(),
        "native": _lacks_compilers() and not is_built(),
    }
    marks = [mark for mark, is_missing in missing.items() if is_missing]
    # `make test` installs no compiler: there the library is as pip has built it, or missing.
    lacks_library = not (is_built() or can_build())
    left_out = [
        item for item in items
        if any(map(item.get_closest_marker, marks)) or _is_for_other_systems(item)
        or (lacks_library and item.get_closest_marker("native")
            and not item.get_closest_marker("full"))
    ]  # fmt: skip
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


def _leave_to_full(items):
    """Mark as `full` all cases of a test with the mark `few`, but as many as that says.

    These lie evenly among its cases.
    """
    cases = defaultdict(list)
    for item in items:
        if item.get_closest_marker("few"):
            cases[item.nodeid.partition("[")[0]].append(item)
    for those in cases.values():
        (n,) = those[0].get_closest_marker("few").args
        kept = {len(those) * i // n for i in range(n)}
        for number, item in enumerate(those):
            if number not in kept:
                item.add_marker("full")


def _is_for_other_systems(item) -> bool:
    """Say whether a test names a reason why it cannot run here, and here is not Linux.

    On Linux, where all tests can run, the same test is skipped, which fails in CI.
    """
    return sys.platform != "linux" and any(
        mark.args and mark.args[0] for mark in item.iter_markers("skipif")
    )


def _turn(path: Path) -> int:
    """Return the place of a test's file or directory in `FIRST`, or the one after all of them."""
    parts = path.relative_to(TESTS).parts
    return next((i for i, name in enumerate(FIRST) if name in parts), len(FIRST))


def pytest_collection_finish():
    """Let pytest say in short where two values differ: in CI it compares large files for hours."""
    for name in ("CI", "BUILD_NUMBER"):
        os.environ.pop(name, None)


def pytest_sessionfinish(session):
    """In CI a skipped test is a failure: it would be forgotten otherwise."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if not IN_CI or reporter is None:
        return
    n_skipped = len(reporter.stats.get("skipped", []))
    if n_skipped and session.exitstatus in (
        pytest.ExitCode.OK,
        pytest.ExitCode.NO_TESTS_COLLECTED,
    ):
        reporter.write_line(f"{n_skipped} skipped, and CI is set: failed", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
