"""GDAL's XML of datasets: warped rasters, and facts that only the XML states."""

import os
import xml.etree.ElementTree as ET
from typing import Any


def text_of(dataset: Any) -> str:
    return "".join(dataset.tags(ns="xml:VRT").values())


def rectangles_of(source: ET.Element, default: float) -> list[list[float]]:
    """Return the rectangles that a source copies from and to, as far as it states them.

    Each is (row, col, n_rows, n_cols), with `default` for a number that is missing.
    """
    return [
        [float(one.get(name, default)) for name in ("yOff", "xOff", "ySize", "xSize")]
        for one in map(source.find, ("SrcRect", "DstRect"))
        if one is not None
    ]


def path_of(element: ET.Element, folder: str) -> str:
    name = element.text or ""
    return os.path.join(folder, name) if element.get("relativeToVRT", "0") == "1" else name
