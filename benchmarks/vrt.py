"""Compress one raster as 10,000 files and as one: ``python -m benchmarks.vrt dem.tif``.

The raster mirrors `dem.tif`: 100 x 100 tiles of 128², each a GeoTIFF of its own. It is compressed
(`rapid`, --max-error 1, two threads, without proof: the heights are read as often as `auto` reads
them in passes A and B) as

* ``one``: one GeoTIFF, ``striped``: the same in strips;
* ``vrt``: a VRT over the tiles, written here without GDAL's tools; ``vrt-shuffled`` with the
  sources in another order, ``vrt-few`` where GDAL may keep 10 of them open and the process 64
  files;
* ``mosaic``: terrainwave's own, of 10,000 paths.

All files must have the same bytes. `open_files` is the most that were open at a time (Linux).
"""

import hashlib
import os
import random
import sys
import threading
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

from benchmarks import common

SIDE = 128
LIMIT = 64

# The list of a mosaic is longer than a command line may be elsewhere.
_COMPRESS = """
import sys
from pathlib import Path
import terrainwave
source, target = sys.argv[1:]
if source.endswith(".txt"):
    source = Path(source).read_text().splitlines()
terrainwave.compress(
    source, target, max_error=1, method="rapid", threads=2, verify=False, overwrite=True
)
"""
# Of each run: the raster's file, what the environment has besides, the most files it may open.
RUNS: dict[str, tuple[str, dict[str, str], int | None]] = {
    "one": ("one.tif", {}, None),
    "striped": ("striped.tif", {}, None),
    "vrt": ("tiles.vrt", {}, None),
    "vrt-shuffled": ("shuffled.vrt", {}, None),
    "vrt-few": ("tiles.vrt", {"GDAL_MAX_DATASET_POOL_SIZE": "10"}, LIMIT),
    "mosaic": ("tiles.txt", {}, None),
}

# One line of the CSV.
Row = namedtuple("Row", "source n_files size seconds cpu_seconds peak_mib open_files n_bytes")


def make(dem: str, folder: str, n: int) -> None:
    """Make the raster in all its forms; imports rasterio, so another process does it."""
    import rasterio
    from rasterio.windows import Window

    from benchmarks.rasters import make_mirrored, vrt_source

    place = Path(folder)
    for name, layout in (("one.tif", "tiled"), ("striped.tif", "striped")):
        make_mirrored(Path(dem), place / name, n * SIDE, layout)
    (place / "tiles").mkdir(exist_ok=True)
    paths = []
    with rasterio.open(place / "one.tif") as whole:
        profile = whole.profile | {"width": SIDE, "height": SIDE, "tiled": False}
        for key in ("blockxsize", "blockysize"):
            del profile[key]
        for row in range(n):
            band = whole.read(1, window=Window(0, row * SIDE, n * SIDE, SIDE))
            for col in range(n):
                paths.append(place / "tiles" / f"{row:03}-{col:03}.tif")
                window = Window(col * SIDE, row * SIDE, SIDE, SIDE)
                profile["transform"] = whole.window_transform(window)
                with rasterio.open(paths[-1], "w", **profile) as tile:
                    tile.write(band[:, col * SIDE : (col + 1) * SIDE], 1)
        transform, nodata, crs = whole.transform, whole.nodata, whole.crs
        area = whole.tags().get("AREA_OR_POINT", "")
    (place / "tiles.txt").write_text("\n".join(map(str, paths)), encoding="utf-8")
    part = 0, 0, SIDE, SIDE
    sources = [
        vrt_source(f"tiles/{path.name}", part, k // n * SIDE, k % n * SIDE, nodata)
        for k, path in enumerate(paths)
    ]
    for name in ("tiles.vrt", "shuffled.vrt"):
        lines = [
            f'<VRTDataset rasterXSize="{n * SIDE}" rasterYSize="{n * SIDE}">',
            f"<SRS>{crs.to_wkt()}</SRS>" if crs else "",
            f"<GeoTransform>{','.join(map(repr, transform.to_gdal()))}</GeoTransform>",
            f'<Metadata><MDI key="AREA_OR_POINT">{area}</MDI></Metadata>' if area else "",
            '<VRTRasterBand dataType="Int16" band="1">',
            "" if nodata is None else f"<NoDataValue>{nodata}</NoDataValue>",
            *sources,
            "</VRTRasterBand></VRTDataset>",
        ]
        (place / name).write_text("\n".join(lines), encoding="utf-8")
        random.Random(1).shuffle(sources)


class OpenFiles:
    """Looks at how many files a process has open, every few milliseconds until it ends."""

    def __init__(self) -> None:
        self.most = 0

    def __call__(self, pid: int) -> None:
        """Begin."""
        threading.Thread(target=self._look, args=(pid,), daemon=True).start()

    def _look(self, pid: int) -> None:
        while True:
            try:
                self.most = max(self.most, len(os.listdir(f"/proc/{pid}/fd")))
            except OSError:  # it has ended
                return
            time.sleep(0.005)


def measured(folder: Path, n_tiles: int, runs: tuple[str, ...]) -> Iterator[Row]:
    """Yield the rows of all runs; `SystemExit` if a file differs from the first one."""
    digests = {}
    for name in runs:
        file, more, limit = RUNS[name]
        target, open_files = folder / f"{name}.twz", OpenFiles()
        options = {"env": os.environ | more}
        if limit is not None:
            import resource  # not on Windows

            options["preexec_fn"] = lambda: resource.setrlimit(
                resource.RLIMIT_NOFILE, (LIMIT, LIMIT)
            )
        command = [sys.executable, "-c", _COMPRESS, str(folder / file), str(target)]
        used = common.run_and_measure(command, open_files, **options)
        digests[name] = hashlib.sha256(target.read_bytes()).hexdigest()
        yield Row(
            name, 1 if file.endswith(".tif") else n_tiles**2, n_tiles * SIDE,
            round(used.seconds, 1), round(used.cpu_seconds, 1), round(used.peak_mib, 1),
            open_files.most, target.stat().st_size,
        )  # fmt: skip
        if digests[name] != digests[runs[0]]:
            raise SystemExit(f"{name}: other bytes than {runs[0]}")


@common.command("scale_vrt.csv")
@common.dem_argument
@common.option("--tiles", type=common.COUNT, default=100, help="On a side.")
@common.choices_option("--runs", of=RUNS)
def main(dem: Path, tiles: int, runs: tuple[str, ...], folder: Path, out: Path) -> None:
    """Run the measurement."""
    common.call_elsewhere("benchmarks.vrt.make", dem.absolute(), folder.absolute(), tiles)
    common.write_rows(out, measured(folder, tiles, runs))


if __name__ == "__main__":
    main()
