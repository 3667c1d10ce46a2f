"""glTF 2.0 files of one mesh, as JSON with its buffer inside or as a binary file."""

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.export.frames import vertex_normals
from terrainwave.mesh.mesh_data import MeshData

# Constants of the specification: types of components, targets of views, filters and wrapping.
_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_LINEAR, _LINEAR_MIPMAP, _TO_EDGE = 9729, 9987, 33071
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}
# A PNG.
_WHITE_PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGP4DwABAQEAsTj2FAAAAABJRU5ErkJggg=="
)
# Colour of the ground without a picture: linear, as in glTF, and sRGB, as in pictures.
_COLOR = 0.75, 0.72, 0.66
GROUND_COLOR = 225, 221, 212
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942


def write_gltf(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    """Return a .gltf file of a mesh whose y points upwards; `about` becomes extras of the mesh."""
    document, data = _document(mesh, about)
    uri = base64.b64encode(data).decode("ascii")
    document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{uri}"
    return _as_json(document)


def write_glb(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    """Return a .glb file of a mesh whose y points upwards; `about` becomes extras of the mesh."""
    document, data = _document(mesh, about)
    text = _as_json(document)
    text = text.ljust(-(-len(text) // 4) * 4)
    chunks = struct.pack("<II", len(text), _JSON) + text
    chunks += struct.pack("<II", len(data), _BINARY) + data
    return struct.pack("<III", _MAGIC, 2, 12 + len(chunks)) + chunks


def _as_json(document: dict[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


class _Buffer:
    """The only buffer of a file; its parts begin at multiples of four bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._n_bytes = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, data: bytes, **view: Any) -> int:
        self.views.append(
            {"buffer": 0, "byteOffset": self._n_bytes, "byteLength": len(data)} | view
        )
        padded = data.ljust(-(-len(data) // 4) * 4, b"\0")
        self._parts.append(padded)
        self._n_bytes += len(padded)
        return len(self.views) - 1

    def add_array(self, values: NDArray[np.generic], kind: int, target: int, **more: Any) -> int:
        view = self.add(values.tobytes(), target=target)
        n_columns = values.shape[1] if values.ndim > 1 else 1
        self.accessors.append(
            {"bufferView": view, "componentType": kind, "count": len(values)}
            | {"type": _KINDS[n_columns]}
            | more
        )
        return len(self.accessors) - 1

    def data(self) -> bytes:
        return b"".join(self._parts)


def _document(mesh: MeshData, about: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
    buffer = _Buffer()
    points = np.ascontiguousarray(mesh.vertices, dtype="<f4")
    attributes = {
        "POSITION": buffer.add_array(
            points, _FLOAT, _VERTICES, min=_numbers(points.min(0)), max=_numbers(points.max(0))
        )
    }
    uv = mesh.attributes.get("uv")
    texture: tuple[bytes, str] | None = mesh.attributes.get("texture")
    solid = mesh.attributes.get("solid")
    materials = [_material("ground", _COLOR if texture is None else (1.0, 1.0, 1.0))]
    document: dict[str, Any] = {}
    # A body's edges are sharp.
    if uv is not None and solid is None:
        normals = vertex_normals(mesh).astype("<f4")
        attributes["NORMAL"] = buffer.add_array(normals, _FLOAT, _VERTICES)
    of_walls = dict(attributes)
    if uv is not None:
        # glTF counts v from the top of a picture.
        places = np.column_stack([uv[:, 0], 1 - uv[:, 1]]).astype("<f4")
        attributes["TEXCOORD_0"] = buffer.add_array(places, _FLOAT, _VERTICES)
        # A placeholder picture that can be replaced: the texture coordinates belong to it.
        data, kind = texture or (_WHITE_PIXEL, "image/png")
        document["images"] = [{"name": "ground", "mimeType": kind, "bufferView": buffer.add(data)}]
        sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP}
        document["samplers"] = [sampler | {"wrapS": _TO_EDGE, "wrapT": _TO_EDGE}]
        document["textures"] = [{"sampler": 0, "source": 0}]
        materials[0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    corners = np.ascontiguousarray(mesh.triangles, dtype="<u4").reshape(-1)
    parts = [corners]
    if texture is not None and solid is not None:
        # Walls and base are not visible in a picture from above.
        parts = np.split(corners, [3 * solid["n_triangles"]])
        materials.append(_material("walls", _COLOR))
    primitives = [
        {
            "attributes": attributes if number == 0 else of_walls,
            "indices": buffer.add_array(part, _UNSIGNED, _INDICES),
            "material": number,
        }
        for number, part in enumerate(parts)
    ]
    lod = about.get("lod")
    name = "terrain" if lod is None else f"terrain_lod{lod}"
    data = buffer.data()
    document |= {
        "asset": {"version": "2.0", "generator": about["generator"]},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [{"name": name, "primitives": primitives, "extras": {"terrainwave": about}}],
        "materials": materials,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(data)}],
    }
    return document, data


def _material(name: str, color: tuple[float, float, float]) -> dict[str, Any]:
    # Without a material programs assume polished metal.
    rough = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"name": name, "pbrMetallicRoughness": rough}


def _numbers(values: NDArray[np.float32]) -> list[float]:
    return [float(value) for value in values]
