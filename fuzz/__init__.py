"""Coverage-guided fuzzing of all that reads untrusted bytes (docs/reliability.md)."""

import os

# Kernels as plain Python take some hundred times as long: targets give them few samples.
IS_COMPILED = os.environ.get("NUMBA_DISABLE_JIT", "0") in {"", "0"}
