"""Formats of mesh files, and the form of a mesh in them."""

import os
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from terrainwave.arguments import AS_IS, RADIUS_HELP, UPWARDS, VERTICAL, VERTICAL_HELP
from terrainwave.errors import InvalidArgumentError
from terrainwave.option_sets import PATH, OptionSet, number, option, words

FRAMES = ("local", "native", "ecef")


@dataclass(frozen=True)
class MeshFormat:
    """Format of mesh files."""

    # module and function in `export` that return the bytes of a file, of a mesh in the frame of the
    # file, what the file is to say of it, and the path
    writer: str
    package: str | None = None  # package that the writer needs, of the extra ``mesh``
    is_float32: bool = False  # its coordinates are, so they count from the middle of the mesh
    # surfaces have normals and texture coordinates; the picture itself can be in the file
    has_normals: bool = False
    has_picture: bool = False
    up: str = "z"  # its upward axis by default

    def write(self, *given: Any) -> bytes:
        module, name = self.writer.split(".")
        data: bytes = getattr(import_module(f"{__package__}.{module}"), name)(*given)
        return data


MESH_FORMATS = {
    ".ply": MeshFormat("mesh_formats.write_ply", "meshio"),
    ".obj": MeshFormat("mesh_formats.write_obj", has_normals=True),
    ".stl": MeshFormat("mesh_formats.write_stl", "trimesh", is_float32=True),
    ".glb": MeshFormat("gltf.write_glb", is_float32=True, has_normals=True,
                       has_picture=True, up="y"),
    ".gltf": MeshFormat("gltf.write_gltf", is_float32=True, has_normals=True,
                        has_picture=True, up="y"),
    ".vtu": MeshFormat("mesh_formats.write_vtu", "meshio"),
    ".vtk": MeshFormat("mesh_formats.write_vtk", "meshio"),
}  # fmt: skip
# A Cesium quantized-mesh tile, whose frame is its own (`quantized_mesh`).
TILE = ".terrain"
MESH_ENDINGS = (*MESH_FORMATS, TILE)


@dataclass(frozen=True, kw_only=True)
class Shape(OptionSet):
    """Form of a mesh in a file: options of `Mesh.save`, which describes them."""

    frame: str | None = option(
        words(*FRAMES),
        "Coordinates: metres from the middle (local), those of the CRS (native), or geocentric"
        " (ecef). Default: local where the CRS has degrees, else native.",
    )
    z_scale: float = option(number(above=0), "Multiply heights by this factor.", default=1.0)
    solid: float | None = option(
        number(),
        "Write a watertight body with a flat base at this height, in the file's unit, to print.",
    )
    skirts: float | None = option(
        number(above=0),
        "Hang walls of this height, in the file's unit, from all borders. They hide gaps next to"
        " meshes of another error.",
        typed={"metavar": "HEIGHT"},
    )
    up: str | None = option(
        words(*UPWARDS),
        "Axis that points upwards. Default: y in .glb and .gltf, which allow no other, z in other"
        " formats.",
    )
    drape: str | os.PathLike[str] | None = option(
        PATH,
        "Put a picture on the mesh, in .glb and .gltf: an orthophoto, warped to the terrain's CRS"
        " (a file, a URL or the URL of tiles, https://.../{z}/{x}/{y}.png), or a picture without"
        " coordinates, which covers the whole terrain.",
        typed={"metavar": "IMAGE"},
    )
    radius: float | None = option(number(above=0), RADIUS_HELP, typed={"metavar": "METRES"})
    vertical: str = option(words(*VERTICAL), f"Heights on the globe{VERTICAL_HELP}", default=AS_IS)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.solid is not None and self.skirts is not None:
            raise InvalidArgumentError(
                "found `solid` and `skirts`, expected one of them: the walls of a body reach its"
                " base"
            )
