"""QGIS plugin: .twz files as layers, and what makes and checks them as Processing algorithms."""


def classFactory(iface):  # the name that QGIS calls
    """Return the plugin."""
    from terrainwave_plugin.plugin import Plugin

    return Plugin(iface)
