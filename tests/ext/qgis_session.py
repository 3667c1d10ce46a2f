"""Run by QGIS's Python, without a window: uses the plugin as QGIS does, prints what came of it.

Arguments: the folder of the plugin, a raster, a folder to write to. PATH has the command.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

plugins, raster, folder = sys.argv[1:]
sys.path[:0] = [plugins, "/usr/share/qgis/python/plugins"]

from qgis.core import (  # noqa: E402
    Qgis,
    QgsApplication,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProject,
    QgsRasterBandStats,
    QgsSettings,
)  # fmt: skip
from qgis.gui import QgsMessageBar  # noqa: E402
from qgis.PyQt.QtCore import QMimeData, QSize, QUrl  # noqa: E402
from qgis.PyQt.QtGui import QColor  # noqa: E402
from qgis.PyQt.QtWidgets import QMainWindow, QMenu  # noqa: E402

PATIENCE = 120
folder = Path(folder)
found = {"version": Qgis.QGIS_VERSION}


class Interface:
    """What the plugin uses of QGIS's window."""

    def __init__(self):
        self.window, self.menu, self.bar = QMainWindow(), QMenu(), QgsMessageBar()
        self.drops, self.entries = [], []
        self.mainWindow = lambda: self.window
        self.addLayerMenu = lambda: self.menu
        self.messageBar = lambda: self.bar
        self.registerCustomDropHandler = self.drops.append
        self.unregisterCustomDropHandler = self.drops.remove
        self.addPluginToMenu = lambda menu, action: self.entries.append(action)
        self.removePluginMenu = lambda menu, action: self.entries.remove(action)


class Feedback(QgsProcessingFeedback):
    """Writes down what it is told; cancels at the first progress if it shall."""

    def __init__(self, cancels=False):
        super().__init__()
        self.stages, self.percents, self.cancels = [], [], cancels

    def setProgressText(self, text):
        self.stages.append(text)
        if self.cancels:
            self.cancel()

    def setProgress(self, percent):
        self.percents.append(percent)


def wait_for(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        application.processEvents()
        assert time.monotonic() < end, "never true"
        time.sleep(0.01)


def run(name, feedback=None, **parameters):
    algorithm = QgsApplication.processingRegistry().createAlgorithmById(f"terrainwave:{name}")
    context = QgsProcessingContext()
    context.setProject(project)
    feedback = feedback or Feedback()
    is_good, complaint = algorithm.checkParameterValues(parameters, context)
    assert is_good, complaint
    return algorithm.run(parameters, context, feedback, catchExceptions=False)[0]


def failure(name, **parameters):
    try:
        run(name, **parameters)
    except QgsProcessingException as error:
        return str(error)


def heights(layer):
    """Return statistics of all heights; the first band's bytes go to a file."""
    provider = layer.dataProvider()
    extent = layer.extent()
    block = provider.block(1, extent, layer.width(), layer.height())
    (folder / "heights").write_bytes(bytes(block.data()))
    all_of = (
        QgsRasterBandStats.Stats.All
        if hasattr(QgsRasterBandStats, "Stats")
        else (QgsRasterBandStats.All)
    )
    told = provider.bandStatistics(1, all_of, extent, 0)
    return [told.minimumValue, told.maximumValue, told.mean, told.elementCount]


def picture(layer, path):
    settings = QgsMapSettings()
    settings.setLayers([layer])
    settings.setDestinationCrs(layer.crs())
    settings.setExtent(layer.extent())
    settings.setOutputSize(QSize(600, 400))
    settings.setBackgroundColor(QColor("#3060c0"))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    image = job.renderedImage()
    image.save(str(path))
    return len({image.pixel(x, y) for x in range(0, 600, 7) for y in range(0, 400, 7)})


def message():
    """Return the text of the message that is shown, and take it away."""
    item = interface.bar.currentItem()
    text = item.text() if item else ""
    interface.bar.clearWidgets()
    return text


def only_layer():
    (layer,) = project.mapLayers().values()
    return layer


application = QgsApplication([], True)
application.initQgis()
QgsSettings().remove("terrainwave")
project, interface = QgsProject.instance(), Interface()

from terrainwave_plugin import classFactory  # noqa: E402

plugin = classFactory(interface)
plugin.initGui()
(drop,) = interface.drops
found["entries"] = [action.text() for action in interface.entries]

# Processing
packed = str(folder / "packed.twz")
feedback = Feedback()
found["compress"] = run("compress", feedback, INPUT=raster, MAX_ERROR=2.0, OUTPUT=packed)
found["stages"], found["percents"] = feedback.stages, feedback.percents
found["verify"] = run("verify", INPUT=packed, ORIGINAL=raster)
found["too strict"] = failure("verify", INPUT=packed, ORIGINAL=raster, MAX_ERROR=0.5)
meshing = Feedback()
found["mesh"] = run("mesh", meshing, INPUT=packed, MAX_ERROR=20.0, OUTPUT=str(folder / "mesh.ply"))
found["stages of mesh"] = meshing.stages
found["decompress"] = run("decompress", INPUT=packed, OUTPUT=str(folder / "back.tif"))
before = sorted(os.listdir(folder))
found["cancelled"] = failure(
    "compress", feedback=Feedback(cancels=True), INPUT=raster, OUTPUT=str(folder / "never.twz")
)
found["left behind"] = sorted(set(os.listdir(folder)) - set(before))

# Layers
started = time.monotonic()
found["other files are taken"] = drop.handleFileDrop(raster)
found["file is taken"] = drop.handleFileDrop(packed)
found["seconds that a drop blocks"] = time.monotonic() - started
wait_for(project.mapLayers)
layer = only_layer()
found["name"], found["crs"] = layer.name(), layer.crs().authid()
found["statistics"] = heights(layer)
found["metadata"] = layer.metadata().abstract()
found["shown metadata"] = layer.htmlMetadata()
found["colours"] = picture(layer, folder / "canvas.png")

address = layer.source().replace("/vsicurl/", "").replace(".tif", ".twz")
mime = QMimeData()
mime.setUrls([QUrl(address)])
found["address is taken"] = drop.handleMimeDataV2(mime)
wait_for(lambda: len(project.mapLayers()) == 2)
remote = next(other for other in project.mapLayers().values() if other != layer)
found["statistics by address"] = heights(remote)
project.removeMapLayer(remote.id())

message()
plugin.add(str(folder / "missing.twz"))
wait_for(interface.bar.currentItem)
found["missing"] = message()

# The server dies, and another one takes over: in this session, and where a project is opened.
os.kill(plugin._server._process.processId(), signal.SIGKILL)
wait_for(interface.bar.currentItem)
found["crash"] = message()
source = layer.source()
plugin.connect_again()
wait_for(lambda: layer.source() != source)
found["statistics after a crash"] = heights(layer)
source = layer.source()
project.write(str(folder / "project.qgz"))
project.clear()
plugin._server.close()
project.read(str(folder / "project.qgz"))
wait_for(lambda: only_layer().source() != source)
found["statistics of a project"] = heights(only_layer())
found["renderer of a project"] = only_layer().renderer().contrastEnhancement().maximumValue()

# The command is looked for where the settings say.
QgsSettings().setValue("terrainwave/command", str(folder))
found["no command"] = failure("verify", INPUT=packed)
QgsSettings().remove("terrainwave")

server = plugin._server._process.processId()
plugin.unload()
found["entries after unload"] = len(interface.entries) + len(interface.drops)
try:
    os.kill(server, 0)
    found["server after unload"] = "runs"
except ProcessLookupError:
    found["server after unload"] = "gone"
print(json.dumps(found))
sys.stdout.flush()
# Python would take QGIS's objects apart in any order.
os._exit(0)
