"""What QGIS loads: menus, drops, the Processing provider, the server behind the layers."""

from __future__ import annotations

import os

from qgis.core import Qgis, QgsApplication, QgsMessageLog, QgsProject, QgsSettings
from qgis.PyQt.QtGui import QIcon
from qgis.PyQt.QtWidgets import QAction, QFileDialog, QInputDialog

from terrainwave_plugin import layers
from terrainwave_plugin.algorithms import Provider
from terrainwave_plugin.command import SETTING
from terrainwave_plugin.drops import DropHandler
from terrainwave_plugin.server import Server

ICON = os.path.join(os.path.dirname(__file__), "icon.svg")
MENU = "terrainwave"
_SECONDS_OF_MESSAGE = 10


class Plugin:
    """Opens .twz files as layers.

    Parameters
    ----------
    iface : QgisInterface
    """

    def __init__(self, iface) -> None:
        self._iface = iface
        self._actions: list[QAction] = []
        # {file: layers that wait for its new address}
        self._lost: dict[str, list] = {}

    def initProcessing(self) -> None:
        """Add the algorithms; all that qgis_process asks for."""
        self._provider = Provider(QIcon(ICON))
        QgsApplication.processingRegistry().addProvider(self._provider)

    def initGui(self) -> None:
        """Add menus and handlers."""
        self.initProcessing()
        self._server = Server()
        self._server.served.connect(self._show)
        self._server.refused.connect(self._refuse)
        self._server.told.connect(self._tell)
        self._server.crashed.connect(self._mourn)
        for text, do in (
            ("Add terrainwave Layer…", self.ask_for_files),
            ("Add terrainwave Layer by Address…", self.ask_for_address),
            ("Connect Layers Again", self.connect_again),
            ("Settings…", self.ask_for_command),
        ):
            action = QAction(QIcon(ICON), text, self._iface.mainWindow())
            action.triggered.connect(do)
            self._iface.addPluginToMenu(MENU, action)
            self._actions.append(action)
        for action in self._actions[:2]:
            self._iface.addLayerMenu().addAction(action)
        self._drops = DropHandler(self.add)
        self._iface.registerCustomDropHandler(self._drops)
        QgsProject.instance().readProject.connect(self.connect_again)

    def unload(self) -> None:
        """Take all of it away, and end the server."""
        QgsApplication.processingRegistry().removeProvider(self._provider)
        QgsProject.instance().readProject.disconnect(self.connect_again)
        self._iface.unregisterCustomDropHandler(self._drops)
        for action in self._actions:
            self._iface.removePluginMenu(MENU, action)
            self._iface.addLayerMenu().removeAction(action)
        self._actions.clear()
        self._server.close()

    def add(self, file: str) -> None:
        """Add a layer of a path or a URL, as soon as the server has it."""
        self._server.serve(file)

    def ask_for_files(self) -> None:
        """Let the user choose files to add."""
        files, _ = QFileDialog.getOpenFileNames(
            self._iface.mainWindow(), "Add terrainwave Layer", "", "terrainwave (*.twz)"
        )
        for file in files:
            self.add(file)

    def ask_for_address(self) -> None:
        """Let the user type the address of a file to add."""
        address, is_given = QInputDialog.getText(
            self._iface.mainWindow(), "Add terrainwave Layer", "Address of a .twz file:"
        )
        if is_given and address.strip():
            self.add(address.strip())

    def ask_for_command(self) -> None:
        """Let the user name the environment that the command is in."""
        settings = QgsSettings()
        chosen, is_given = QInputDialog.getText(
            self._iface.mainWindow(),
            "terrainwave",
            "The terrainwave command, or the folder of the environment it is in"
            " (empty: the one on the PATH):",
            text=settings.value(SETTING, "", type=str),
        )
        if is_given:
            settings.setValue(SETTING, chosen.strip())

    def connect_again(self) -> None:
        """Serve the files of all layers anew: after a project is read, or the server has ended."""
        self._lost.clear()
        for layer in layers.terrain_layers():
            self._lost.setdefault(layer.customProperty(layers.SOURCE), []).append(layer.id())
        for file in self._lost:
            self._server.serve(file)

    def _show(self, file: str, url: str, info: dict) -> None:
        lost = self._lost.pop(file, None)
        project = QgsProject.instance()
        if lost is not None:
            for layer in filter(None, map(project.mapLayer, lost)):
                layers.connect_again(layer, url)
            return
        layer = layers.make_layer(file, url, info)
        if layer.isValid():
            project.addMapLayer(layer)
        else:
            self._warn(f"{file}: GDAL cannot read {url}")

    def _refuse(self, file: str, reason: str) -> None:
        self._lost.pop(file, None)
        self._warn(reason)

    def _tell(self, text: str) -> None:
        QgsMessageLog.logMessage(text, MENU, Qgis.MessageLevel.Info)
        self._show_message(text.splitlines()[-1], Qgis.MessageLevel.Info)

    def _mourn(self, reason: str) -> None:
        self._lost.clear()
        self._warn(f"its server ended: {reason} (Plugins > {MENU} > Connect Layers Again)")

    def _warn(self, text: str) -> None:
        self._show_message(text, Qgis.MessageLevel.Warning)

    def _show_message(self, text: str, level: Qgis.MessageLevel) -> None:
        self._iface.messageBar().pushMessage(MENU, text, level, _SECONDS_OF_MESSAGE)
