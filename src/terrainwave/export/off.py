"""Meshes as OFF, the text format of Geomview."""

import json
from pathlib import Path
from typing import Any

from terrainwave.mesh.mesh_data import MeshData


def write_off(mesh: MeshData, about: dict[str, Any], path: Path) -> bytes:
    """Return an OFF file."""
    lines = ["OFF", f"# terrainwave {json.dumps(about, allow_nan=False)}"]
    lines.append(f"{len(mesh.vertices)} {mesh.n_triangles} 0")
    lines += [f"{x:.9f} {y:.9f} {z:.9f}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in mesh.triangles.tolist()]
    return ("\n".join(lines) + "\n").encode()
