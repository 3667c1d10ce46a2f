"""The command line: each command parses, calls the library and prints.

Exit status: 0 good; 1 any failure, one line on stderr; 2 wrong usage; 130 interrupted (Ctrl-C), 143
terminated (SIGTERM), 129 hung up (SIGHUP). A legal request beyond a limit of memory or size
(`LimitExceededError`) is a failure: the same command may succeed with another file or on another
machine. Numba and rasterio are imported inside the commands, so that --help answers at once.
"""

from terrainwave.cli.commands import main

__all__ = ["main"]
