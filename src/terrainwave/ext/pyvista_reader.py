"""``pyvista.read("a.twz")``: a guaranteed mesh as `pyvista.PolyData`."""

from typing import Any

from terrainwave.export.curvature import divided
from terrainwave.export.frames import globe_way, to_frame
from terrainwave.export.mesh_files import mesh_for_file
from terrainwave.export.mesh_formats import to_pyvista
from terrainwave.file import TerrainFile
from terrainwave.mesh.area import mesh_area
from terrainwave.mesh.mesh_data import MeshData


def read_twz(
    path: str,
    /,
    *,
    max_error: float | None = None,
    max_triangles: int | None = None,
    level: int = -1,
    window: Any = None,
    bounds: Any = None,
    optimise: int = 1,
    frame: str | None = "local",
    z_scale: float = 1.0,
) -> Any:
    """Return a crack-free mesh of a .twz file, with its heights as point data.

    Parameters
    ----------
    path : str
        Path or URL.
    max_error, max_triangles, level, window, bounds, optimise
        Mesh and area, as for `Terrain.mesh`. For a file without meshes, the default is a mesh
        within its own error plus its vertical quantum.
    frame, z_scale
        Coordinates as for `Mesh.save`: local metres, or ``"native"`` or ``"ecef"``.

    Returns
    -------
    surface : pyvista.PolyData
        Points relative to ``field_data["origin"]``; point data ``heights`` in the file's unit;
        ``field_data`` also has ``error``, the largest distance from any valid original, ``units``,
        ``crs``. The error only holds for the returned surface, although pyvista's filters copy it
        to others.

    Raises
    ------
    InvalidHeightsError
        If an argument is out of range.
    CorruptStreamError, StorageError
        If the file is damaged or cannot be read.
    """
    asked = max_error
    with TerrainFile(path) as terrain:
        if max_error is None and max_triangles is None and terrain.mesh_kind == "none":
            max_error = terrain.quanta_error + terrain.info().quantum

        def made(error: float | None) -> MeshData:
            return mesh_area(
                terrain, MeshData, window, bounds=bounds, level=level, max_error=error,
                max_triangles=max_triangles, optimise=optimise,
            )  # fmt: skip

        if frame == "ecef" and asked is not None:
            # As in a file without rounding.
            shape = {"frame": frame, "z_scale": z_scale}
            mesh, _ = mesh_for_file(made, "mesh.vtu", asked, terrain.quanta_error, **shape)
        else:
            mesh = made(max_error)
        if frame == "ecef":
            mesh = divided(mesh, globe_way(mesh, z_scale=z_scale))
        placed = to_frame(mesh, frame, z_scale=z_scale)
        surface = to_pyvista(placed)
        surface.point_data["heights"] = mesh.points[:, 2]
        surface.set_active_scalars("heights")
        surface.field_data["origin"] = placed.origin
        surface.field_data["error"] = [placed.error]
        surface.field_data["units"] = [terrain.units or ""]
        surface.field_data["crs"] = [terrain.crs or ""]
    return surface
