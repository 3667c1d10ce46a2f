"""Choice between two compilers of kernels: the fast one of `compiler`, and numba's own.

The fast one takes 0.6 of the time (docs/decisions/0019-how-kernels-are-compiled.md), but uses
private parts of numba. So it is used only with numba releases that CI has tested, and if all names
that it needs exist. With other releases kernels are as fast, and produce the same bytes.
"""

import os
import warnings
from typing import Any

import numba
from numba.core import config
from numba.core.registry import CPUDispatcher

from terrainwave.errors import InvalidArgumentError, TerrainwaveWarning

# Minor releases that CI runs (.github/workflows/test.yml: a test compares).
TRIED = ("0.65", "0.66", "0.67", "0.68")

# Selects one of the two; for tests, and to try another release of numba.
VARIABLE = "TERRAINWAVE_COMPILER"


def _chosen() -> tuple[str, type[CPUDispatcher]]:
    """Return the compiler's name and dispatcher; warn if it is not the fast one."""
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "fast", "plain"):
        raise InvalidArgumentError(f"{VARIABLE}: found {asked}, expected fast, plain or nothing")
    if asked == "plain" or config.DISABLE_JIT:
        return "plain", CPUDispatcher
    minor = ".".join(numba.__version__.split(".")[:2])
    if minor not in TRIED and not asked:
        return "plain", _own(f"terrainwave was tried with numba {TRIED[0]} to {TRIED[-1]}")
    try:
        from terrainwave.coding import compiler

        missing = compiler.missing_names()
    except (ImportError, AttributeError, TypeError) as error:
        missing = [str(error)]
    if missing:
        return "plain", _own(f"it lacks what terrainwave's compiler needs: {', '.join(missing)}")
    return "fast", compiler.Kernel


def _own(why: str) -> type[CPUDispatcher]:
    """Return numba's own dispatcher, and warn with the reason."""
    warnings.warn(
        f"numba is {numba.__version__}, and {why}; kernels are compiled by numba alone, which takes"
        " longer the first time and changes nothing else",
        TerrainwaveWarning,
        stacklevel=2,
    )
    return CPUDispatcher


COMPILER, Kernel = _chosen()


def _keeping() -> tuple[Any, str]:
    """Return the class of caches, or None with the reason."""
    if os.environ.get("TERRAINWAVE_NUMBA_CACHE", "1") == "0":
        return None, "TERRAINWAVE_NUMBA_CACHE is 0; unset it"
    if config.DISABLE_JIT:
        return None, "NUMBA_DISABLE_JIT is set; unset it"
    try:
        from terrainwave.coding import kernel_cache

        missing = kernel_cache.missing_names()
    except (ImportError, AttributeError, TypeError) as error:
        missing = [str(error)]
    if not missing:
        return kernel_cache.KernelCache, ""
    # Without our stamp an entry would outlive its sources: a broken bound.
    why = f"numba {numba.__version__} keeps kernels in another way ({', '.join(missing)})"
    warnings.warn(
        f"compiled kernels are not kept: {why}; every run compiles them again",
        TerrainwaveWarning,
        stacklevel=2,
    )
    return None, f"{why}; install a release of numba that terrainwave was tried with"


KernelCache, WHY_NOT_KEPT = _keeping()
