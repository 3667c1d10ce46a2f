"""Optional packages: imported where something needs them, named where they are missing."""

from importlib import import_module
from typing import Any

from terrainwave.errors import TerrainwaveError

# Packages that are installed by another name.
_INSTALLED_AS = {"PIL": "pillow", "socks": "pysocks"}


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
        raise TerrainwaveError(
            f'{purpose} needs {name}: pip install "terrainwave[{extra}]"'
        ) from error
