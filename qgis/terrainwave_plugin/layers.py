"""Raster layers of what the server answers."""

from __future__ import annotations

import html
import os
import re

from qgis.core import (
    QgsContrastEnhancement,
    QgsDataProvider,
    QgsLayerMetadata,
    QgsProject,
    QgsRasterLayer,
    QgsSingleBandGrayRenderer,
)

# The layer's property that names its .twz file; its source is an address of the server.
SOURCE = "terrainwave/source"


def is_terrain(name: str) -> bool:
    """Say whether a path or a URL names a .twz file."""
    return name.split("?")[0].lower().endswith(".twz")


def name_of(file: str) -> str:
    """Return what the layer of a path or a URL is called."""
    return os.path.splitext(re.split(r"[/\\]", file.split("?")[0])[-1])[0]


def make_layer(file: str, url: str, info: dict) -> QgsRasterLayer:
    """Return a layer of a served file, grey between its lowest and highest height.

    Nothing but the head is read: QGIS's own default style would read heights first.
    """
    options = QgsRasterLayer.LayerOptions(False)
    layer = QgsRasterLayer(f"/vsicurl/{url}", name_of(file), "gdal", options)
    layer.setCustomProperty(SOURCE, file)
    layer.setMetadata(_metadata(file, info))
    if layer.isValid() and info["minimum"] is not None:
        stretch = QgsContrastEnhancement(layer.dataProvider().dataType(1))
        stretch.setMinimumValue(info["minimum"])
        stretch.setMaximumValue(info["maximum"])
        stretch.setContrastEnhancementAlgorithm(
            QgsContrastEnhancement.ContrastEnhancementAlgorithm.StretchToMinimumMaximum
        )
        renderer = QgsSingleBandGrayRenderer(layer.dataProvider(), 1)
        renderer.setContrastEnhancement(stretch)
        layer.setRenderer(renderer)
    return layer


def bound_in_words(info: dict) -> str:
    """Return the sentence that tells a file's bound."""
    unit = f" {info['units']}" if info["units"] else " (in the unit of the heights)"
    return (
        f"Every height is within {info['effective_error']:g}{unit} of the original:"
        f" checked when the file was made, which asked for {info['max_error']:g}."
    )


def _metadata(file: str, info: dict) -> QgsLayerMetadata:
    metadata = QgsLayerMetadata()
    metadata.setIdentifier(file)
    metadata.setTitle(name_of(file))
    metadata.setType("dataset")
    about = (
        f"terrainwave file of {info['n_bytes']:,} bytes, method {info['method']},"
        f" {info['bits_per_sample']:.4g} bits per sample. Overviews are averages for looking at:"
        " no bound holds for them."
    )
    metadata.setAbstract(html.escape(f"{bound_in_words(info)} {about}"))
    return metadata


def terrain_layers() -> list[QgsRasterLayer]:
    """Return the project's layers of .twz files."""
    layers = QgsProject.instance().mapLayers().values()
    return [layer for layer in layers if layer.customProperty(SOURCE)]


def connect_again(layer: QgsRasterLayer, url: str) -> None:
    """Let a layer whose server has gone read from this address; its style stays."""
    options = QgsDataProvider.ProviderOptions()
    layer.setDataSource(f"/vsicurl/{url}", layer.name(), "gdal", options)
    layer.triggerRepaint()
