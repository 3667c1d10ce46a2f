"""Run by QGIS's Python, without a window, plugin or server: a .twz file as anyone drops it.

Arguments: the file, a large one (either may be empty), a folder to write to.
"""

import json
import os
import sys
import time
from pathlib import Path

path, large, folder = sys.argv[1:]
folder = Path(folder)

from qgis.core import (  # noqa: E402
    Qgis,
    QgsApplication,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsPointXY,
    QgsProject,
    QgsProviderRegistry,
    QgsRaster,
    QgsRasterBandStats,
    QgsRasterLayer,
    QgsRectangle,
)  # fmt: skip
from qgis.gui import QgsMapCanvas  # noqa: E402
from qgis.PyQt.QtCore import QSize  # noqa: E402
from qgis.PyQt.QtGui import QColor  # noqa: E402

application = QgsApplication([], True)
application.initQgis()
project = QgsProject.instance()
registry = QgsProviderRegistry.instance()
found = {"version": Qgis.QGIS_VERSION}


def render(layer, extent, size=(600, 400)):
    """Return the picture of a layer and the seconds it took."""
    settings = QgsMapSettings()
    settings.setLayers([layer])
    settings.setDestinationCrs(layer.crs())
    settings.setExtent(extent)
    settings.setOutputSize(QSize(*size))
    settings.setBackgroundColor(QColor("#3060c0"))
    started = time.monotonic()
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    image = job.renderedImage()
    return image, time.monotonic() - started


def n_colours(image):
    return len({image.pixel(x, y) for x in range(0, 600, 7) for y in range(0, 400, 7)})


def look_at(path):
    """Do with a file what is done with a dropped one."""
    # What the window looks at where something is dropped: layers that a file holds. More than one
    # opens a dialog.
    sublayers = registry.querySublayers(path)
    found["sublayers"] = [[one.providerKey(), one.name(), one.uri()] for one in sublayers]
    found["is in the filter of files"] = "*.twz" in registry.fileRasterFilters()

    # The plugin, if it is there, leaves the file to QGIS.
    sys.path.insert(0, os.environ["PLUGIN"])
    from terrainwave_plugin.drops import DropHandler

    taken = []
    handler = DropHandler(taken.append)
    found["taken by the plugin"] = [handler.handleFileDrop(path), taken]

    layer = QgsRasterLayer(path, "dem")
    found["valid"], found["provider"] = layer.isValid(), layer.dataProvider().name()
    found["crs"] = layer.crs().authid()
    found["size"] = [layer.width(), layer.height()]
    found["subLayers"] = layer.dataProvider().subLayers()
    project.addMapLayer(layer)
    all_of = getattr(QgsRasterBandStats, "Stats", QgsRasterBandStats).All
    told = layer.dataProvider().bandStatistics(1, all_of, layer.extent(), 0)
    found["statistics"] = [told.minimumValue, told.maximumValue, told.mean, told.elementCount]
    block = layer.dataProvider().block(1, layer.extent(), layer.width(), layer.height())
    (folder / "heights").write_bytes(bytes(block.data()))
    found["is void"] = block.isNoData(60, 110)
    place = QgsPointXY(*json.loads(os.environ["PLACE"]))
    found["identified"] = (
        layer.dataProvider().identify(place, QgsRaster.IdentifyFormatValue).results()[1]
    )
    image, _ = render(layer, layer.extent())
    image.save(str(folder / "canvas.png"))
    found["colours"] = n_colours(image)

    canvas = QgsMapCanvas()
    canvas.resize(500, 400)
    canvas.setLayers([layer])
    canvas.setExtent(layer.extent())
    canvas.show()
    canvas.refresh()
    end = time.monotonic() + 60
    drawn = []
    canvas.mapCanvasRefreshed.connect(lambda: drawn.append(True))
    while not drawn:
        application.processEvents()
        assert time.monotonic() < end, "never drawn"
    canvas.grab().save(str(folder / "window.png"))

    # Many readers of one file at once: each layer of a map is drawn by a thread of its own.
    copies = [QgsRasterLayer(path, f"copy {i}") for i in range(6)]
    settings = QgsMapSettings()
    settings.setLayers(copies)
    settings.setDestinationCrs(layer.crs())
    settings.setExtent(layer.extent())
    settings.setOutputSize(QSize(600, 400))
    settings.setBackgroundColor(QColor("#3060c0"))
    jobs = [QgsMapRendererParallelJob(settings) for _ in range(4)]
    for job in jobs:
        job.start()
    for job in jobs:
        job.waitForFinished()
    found["same pictures"] = all(job.renderedImage() == image for job in jobs)

    project.write(str(folder / "project.qgz"))
    project.clear()
    project.read(str(folder / "project.qgz"))
    (again,) = project.mapLayers().values()
    found["valid in a project"] = again.isValid()
    found["source in a project"] = again.source()


def look_at_large(path):
    """Take the time from a drop to the first picture, and of moves: maps of 1200 x 800 pixels."""
    window = 1200, 800
    started = time.monotonic()
    big = QgsRasterLayer(path, "large")
    opened = time.monotonic() - started
    _, seconds = render(big, big.extent(), window)
    found["first picture"] = opened + seconds
    found["opened"] = opened
    pans = []
    whole = big.extent()
    width, height = whole.width() * 1200 / big.width(), whole.height() * 800 / big.height()
    for step in range(8):
        left = whole.xMinimum() + whole.width() * 0.3 + step * width / 3
        top = whole.yMaximum() - whole.height() * 0.4
        pans.append(render(big, QgsRectangle(left, top - height, left + width, top), window)[1])
    found["pans"] = pans


if path:
    look_at(path)
if large:
    look_at_large(large)
print(json.dumps(found))
sys.stdout.flush()
# Python would take QGIS's objects apart in any order.
os._exit(0)
