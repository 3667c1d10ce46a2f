"""Pack the QGIS plugin: ``python tools/make_qgis_zip.py TARGET.zip``; the same bytes each time."""

import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
PLUGIN = ROOT / "qgis" / "terrainwave_plugin"
_TIME = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip can hold


def contents() -> dict[str, bytes]:
    """Return {name in the zip: bytes}: the plugin with its licence."""
    kinds = (".py", ".svg", ".txt")
    files = {path.name: path.read_bytes() for path in PLUGIN.iterdir() if path.suffix in kinds}
    files["LICENSE"] = (ROOT / "LICENSE").read_bytes()
    return {f"{PLUGIN.name}/{name}": files[name] for name in sorted(files)}


def main(target: Path) -> None:
    """Write the zip."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in contents().items():
            archive.writestr(zipfile.ZipInfo(name, _TIME), data, zipfile.ZIP_DEFLATED)
    print(f"{target}: in QGIS, Plugins > Manage and Install Plugins > Install from ZIP")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
