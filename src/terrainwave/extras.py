"""Optional packages: imported when needed, with a clear message if one is missing."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from terrainwave.errors import TerrainwaveError

# Packages whose name at the registry differs.
_INSTALLED_AS = {"PIL": "pillow", "socks": "pysocks"}

# Extras of tasks share packages: a message names the extra of the task at hand, which has all
# packages that the task needs.
EXTRAS = {
    "demo": ("matplotlib", "pyproj"),
    "view": ("moderngl", "moderngl-window", "pillow", "pyproj"),
    "serve": ("fastapi", "uvicorn", "pillow", "pyproj"),
    "publish": ("pyproj",),
    "pmtiles": ("pmtiles", "pillow", "pyproj"),
}


class _MissingPackageError(TerrainwaveError):
    """A package is missing."""

    def __init__(self, purpose: str, name: str, extra: str) -> None:
        super().__init__(f'{purpose} needs {name}: pip install "terrainwave[{extra}]"')
        self.purpose, self.name = purpose, name

    def __reduce__(self) -> tuple[Any, ...]:
        # Pickled as the public class, which callers of workers can rely on.
        return TerrainwaveError, (str(self),)


@contextmanager
def with_extra(extra: str) -> Iterator[None]:
    """Make errors of missing packages name this extra if it has the package; also a decorator.

    Raises
    ------
    TerrainwaveError
        Instead of the error of `need`.
    """
    try:
        yield
    except _MissingPackageError as error:
        if error.name not in EXTRAS[extra]:
            raise
        raise _MissingPackageError(error.purpose, error.name, extra) from error


def need(package: str, *, extra: str, purpose: str = "this") -> Any:
    """Import an optional package or a module of one.

    Parameters
    ----------
    package : str
        As in an import, such as ``matplotlib.pyplot``.
    extra : str
        The extra of terrainwave that installs it (pyproject.toml).
    purpose : str
        The feature that needs it, for the message.

    Returns
    -------
    module
        The module itself, not its top-level package.

    Raises
    ------
    TerrainwaveError
        If it is missing; the message says how to install it.
    """
    try:
        return import_module(package)
    except ImportError as error:
        # The missing package may be a dependency of this one.
        root = (error.name or package).split(".")[0]
        name = _INSTALLED_AS.get(root, root.replace("_", "-"))
        raise _MissingPackageError(purpose, name, extra) from error
