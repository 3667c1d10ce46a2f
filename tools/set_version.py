"""Set the version at every place that states it: ``python -m tools.set_version 1.1.0``.

Between releases it is the next one's with ``.dev0``, so that nobody takes a build of them for the
release before.
"""

import re
from pathlib import Path

import click
from packaging.version import InvalidVersion, Version

ROOT = Path(__file__).parent.parent
# By file: what stands before the version and after it.
PLACES = {
    "src/terrainwave/_version.py": ('__version__ = "', '"'),
    "js/package.json": ('"version": "', '"'),
    "qgis/terrainwave_plugin/metadata.txt": ("\nversion=", "\n"),
    "conda/recipe.yaml": ('version: "', '"'),
    "CITATION.cff": ('\nversion: "', '"'),
}


def spelled(version: str, name: str) -> str:
    """Return a version as a file spells it: npm wants ``1.1.0-dev.0`` for ``1.1.0.dev0``."""
    return re.sub(r"\.dev(\d+)$", r"-dev.\1", version) if name == "js/package.json" else version


def set_version(version: str, root: Path) -> None:
    """Write `version` into all files of a checkout that state it.

    Raises
    ------
    ValueError
        If a file does not state its version exactly once.
    """
    for name, (before, after) in PLACES.items():
        path = root / name
        pattern = re.compile(f'(?<={re.escape(before)})[^"\n]+(?={re.escape(after)})')
        text, count = pattern.subn(spelled(version, name), path.read_text(encoding="utf-8"))
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
            f"{version} is no version, expected one as 1.1.0 or 1.2.0.dev0"
        ) from error
    set_version(normal, ROOT)


if __name__ == "__main__":
    main()
