"""Quantized-mesh tiles, read by the format's own rules: Cesium's quantized-mesh-1.0."""

import json
import struct

import numpy as np


def read_tile(data):
    """Return (header, u, v, h, triangles, edges, extensions) as Cesium's specification has it."""
    names = ["x", "y", "z", "low", "high", "sx", "sy", "sz", "radius", "ox", "oy", "oz"]
    header = dict(zip(names, struct.unpack_from("<3d2f7d", data), strict=True))
    (n_vertices,) = struct.unpack_from("<I", data, 88)
    at = 92
    columns = []
    for _ in range(3):
        coded = np.frombuffer(data, "<u2", n_vertices, at).astype(np.int64)
        columns.append(np.cumsum((coded >> 1) ^ -(coded & 1)))
        at += 2 * n_vertices
    (n_triangles,) = struct.unpack_from("<I", data, at)
    at += 4
    highest, indices = 0, []
    for code in np.frombuffer(data, "<u2", 3 * n_triangles, at):
        indices.append(highest - int(code))
        highest += code == 0
    at += 6 * n_triangles
    edges = []
    for _ in range(4):
        (count,) = struct.unpack_from("<I", data, at)
        edges.append(np.frombuffer(data, "<u2", count, at + 4))
        at += 4 + 2 * count
    extensions = {}
    while at < len(data):
        kind, length = struct.unpack_from("<BI", data, at)
        extensions[kind] = data[at + 5 : at + 5 + length]
        at += 5 + length
    return header, *columns, np.array(indices).reshape(-1, 3), edges, extensions


def metadata(extensions):
    (length,) = struct.unpack_from("<I", extensions[4])
    assert length == len(extensions[4]) - 4
    return json.loads(extensions[4][4:])
