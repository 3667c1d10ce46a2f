"""Optional packages: imported where something needs them, named where they are missing."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from terrainwave.errors import TerrainwaveError

# Packages that are installed by another name.
_INSTALLED_AS = {"PIL": "pillow", "socks": "pysocks"}

# What the extras for one task have in common with others: a package is named with the extra of the
# task at hand, which has all that the task needs.
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
        # As an error of the public class, which is what a worker's caller can count on.
        return TerrainwaveError, (str(self),)


@contextmanager
def with_extra(extra: str) -> Iterator[None]:
    """Let errors of missing packages name this extra where it has the package; decorates, too.

    Raises
    ------
    TerrainwaveError
        Instead of the one of `need`.
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
        What needs it, for the message.

    Returns
    -------
    module
        The one named, not its package.

    Raises
    ------
    TerrainwaveError
        If it is missing; the line says how to install it.
    """
    try:
        return import_module(package)
    except ImportError as error:
        # What is missing may be a package that this one needs.
        root = (error.name or package).split(".")[0]
        name = _INSTALLED_AS.get(root, root.replace("_", "-"))
        raise _MissingPackageError(purpose, name, extra) from error
