"""What holds for every test: errors of numpy, examples of hypothesis, no skips in CI."""

import importlib.util
import os

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# A silent overflow in an encoder is a broken bound in a file.
np.seterr(all="raise")

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
settings.register_profile("compiled", _COMMON, max_examples=60)
settings.register_profile("python", _COMMON, max_examples=10)
settings.load_profile("python" if WITHOUT_JIT else "compiled")


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


def pytest_collection_modifyitems(config, items):
    """Leave out the tests that need OpenGL where it cannot be had."""
    if not _why_no_gl():
        return
    left_out = [item for item in items if item.get_closest_marker("gl")]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("gl")]


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
