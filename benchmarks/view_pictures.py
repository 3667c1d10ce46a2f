"""Draw the pictures of the README: ``python -m benchmarks.view_pictures DATA``.

DATA is the directory with the rasters named below; the pictures go into docs/images.

Exit status: 0 good; 2 wrong usage.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import click

import terrainwave
from terrainwave.render.offscreen import Offscreen
from terrainwave.render.pictures import choose_camera
from terrainwave.render.style import Style

SIZE = (1200, 675)
IMAGES = Path(__file__).parent.parent / "docs" / "images"
MOON_RADIUS = 1_737_400.0

# picture: raster, bound, camera, style, options of the scene
PICTURES: dict[str, tuple[str, float, str, Style, dict[str, Any]]] = {
    "view-andes": (
        "srtm3_aconcagua_S33W071.tif",
        0.0,
        "-70.12,-32.93,7300,300,-16,50",
        Style(),
        {},
    ),
    "view-moon": (
        "moon_gld100_apennines_256ppd.tif",
        2.0,
        "3.2,17.5,70000,20,-32,50",
        Style(coloring="ramp", ramp="grey", sun=(290, 14), haze=0, background=(5, 6, 10)),
        {"radius": MOON_RADIUS, "exaggeration": 1.5},
    ),
    "view-hills": (
        "srtm1_bigtujunga.tif",
        0.0,
        "377500,3794500,2900,82,-15,46",
        Style(),
        {},
    ),
}


@click.command()
@click.argument("data", type=click.Path(exists=True, file_okay=False, path_type=Path))
def main(data: Path) -> None:
    """Draw the pictures of the README from the rasters in DATA."""
    from PIL import Image

    for name, (raster, bound, line, style, options) in PICTURES.items():
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "terrain.twz"
            terrainwave.compress(data / raster, file, max_error=bound, verify=False)
            with (
                terrainwave.open(file) as terrain,
                Offscreen(terrain, SIZE, **options) as offscreen,
            ):
                camera = choose_camera(offscreen.scene.frame, offscreen.viewport, line)
                image, frames = offscreen.picture(camera, style)
        Image.fromarray(image).save(IMAGES / f"{name}.jpg", quality=88)
        print(f"{name}: {frames.n_triangles:,} triangles of {len(frames.nodes)} blocks")


if __name__ == "__main__":
    sys.exit(main())
