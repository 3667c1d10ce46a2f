"""The native library of terrainwave, which reads .twz files by it where this package is installed.

`LIBRARY` is where it lies; terrainwave asks it for its version before it uses it.
"""

import sys
from pathlib import Path

__version__ = "1.0.0.dev0"

_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
LIBRARY = Path(__file__).with_name(f"libterrainwave{_SUFFIX}")
