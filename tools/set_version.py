"""Set the version at every place that states it: ``python -m tools.set_version 1.0.0``.

Between releases it is the next one's with ``.dev0``, so that nobody takes a build of them for the
release before. CMake and C's preprocessor know numbers alone: theirs are those of the release that
comes.
"""

import re
from collections.abc import Callable
from pathlib import Path

import click
from packaging.version import InvalidVersion, Version

ROOT = Path(__file__).parent.parent


def whole(version: str) -> str:
    """Return a version as Python packages have it."""
    return version


def of_npm(version: str) -> str:
    """Return ``1.0.0-dev.0`` for ``1.0.0.dev0``."""
    return re.sub(r"\.dev(\d+)$", r"-dev.\1", version)


def numbers(version: str) -> str:
    """Return ``1.0.0`` for ``1.0.0.dev0``."""
    return ".".join(number(i)(version) for i in range(3))


def number(index: int) -> Callable[[str], str]:
    """Return what gives one of the numbers of a version, as text: 0 is the major one."""
    return lambda version: str([*Version(version).release, 0, 0][index])


# What stands before the version in a file and after it, and how it is spelled there.
PLACES = [
    ("src/terrainwave/_version.py", '__version__ = "', '"', whole),
    ("js/package.json", '"version": "', '"', of_npm),
    ("qgis/terrainwave_plugin/metadata.txt", "\nversion=", "\n", whole),
    ("conda/recipe.yaml", 'version: "', '"', whole),
    ("conda/gdal/recipe.yaml", 'version: "', '"', whole),
    ("CITATION.cff", '\nversion: "', '"', whole),
    ("native/CMakeLists.txt", "\nproject(terrainwave VERSION ", " ", numbers),
    ("native/include/terrainwave.h", '\n#define TWZ_VERSION "', '"', whole),
    ("native/include/terrainwave.h", "\n#define TWZ_VERSION_MAJOR ", "\n", number(0)),
    ("native/include/terrainwave.h", "\n#define TWZ_VERSION_MINOR ", "\n", number(1)),
    ("native/include/terrainwave.h", "\n#define TWZ_VERSION_PATCH ", "\n", number(2)),
]


def set_version(version: str, root: Path) -> None:
    """Write `version` into all files of a checkout that state it.

    Raises
    ------
    ValueError
        If a place does not state its version exactly once.
    """
    for name, before, after, spelled in PLACES:
        path = root / name
        pattern = re.compile(f'(?<={re.escape(before)})[^"\n]+?(?={re.escape(after)})')
        text, count = pattern.subn(spelled(version), path.read_text(encoding="utf-8"))
        if count != 1:
            raise ValueError(f"{name} states its version {count} times, expected once")
        path.write_text(text, encoding="utf-8")


@click.command(help=__doc__)
@click.argument("version")
def main(version: str) -> None:
    """Check the version and set it."""
    try:
        normal = str(Version(version))
    except InvalidVersion as error:
        raise click.BadParameter(
            f"{version} is no version, expected one as 1.0.0 or 1.1.0.dev0"
        ) from error
    set_version(normal, ROOT)


if __name__ == "__main__":
    main()
