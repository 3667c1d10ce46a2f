"""Sets of levels of detail for game engines: meshes of one area whose errors double.

Each level is a file of its own: few programs read glTF's extension MSFT_lod, which would put all
into one (docs/how-to/games.md).
"""

import logging
import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from terrainwave.arguments import AS_IS, MOST_LODS, check_flags, checked_error, checked_whole
from terrainwave.container.targets.publication import refuse_own_source
from terrainwave.errors import BoundViolationError, InvalidArgumentError, TerrainwaveWarning
from terrainwave.export.mesh_files import (
    check_drape,
    check_extension,
    check_shape,
    mesh_for_file,
    note_on_rounding,
    prepare,
    save_mesh,
    with_texture,
)
from terrainwave.export.mesh_formats import SavedMesh
from terrainwave.export.shapes import Shape
from terrainwave.progress import ProgressCallback
from terrainwave.terrain import Terrain
from terrainwave.verification.on_grid import area_problems

_log = logging.getLogger(__name__)


def save_lods(
    src: str | os.PathLike[str],
    dst: str | os.PathLike[str],
    n_lods: int = 4,
    *,
    max_error: float | None = None,
    window: Any = None,
    bounds: Sequence[float] | None = None,
    optimise: int = 1,
    frame: str | None = None,
    z_scale: float = 1.0,
    solid: float | None = None,
    skirts: float | None = None,
    radius: float | None = None,
    vertical: str = AS_IS,
    up: str | None = None,
    drape: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> list[SavedMesh]:
    """Write meshes of an area of a .twz file in several levels of detail.

    LOD 0 is the finest, as game engines count; each next one may have twice the error. All lie over
    the same area, with the same origin and the same places in a picture.

    Parameters
    ----------
    src : path or URL
        A .twz file.
    dst : path
        ``hills.glb`` stands for ``hills_lod0.glb``, ``hills_lod1.glb`` and so on. The extension
        selects the format, as in `Mesh.save`. No file is written before all meshes are checked.
    n_lods : int
        Number of levels; 1 ... 16.
    max_error : float, optional
        Of LOD 0, the largest vertical distance from any valid original sample, in physical units.
        By default that of the stored meshes, as in `Terrain.mesh`.
    window, bounds, optimise
        As in `Terrain.mesh`.
    frame, z_scale, solid, skirts, radius, vertical, up, drape
        As in `Mesh.save`.
    threads : int, optional
        All processors by default.
    overwrite : bool
        Replace existing files.

    Returns
    -------
    list of SavedMesh
        From the finest to the coarsest. Each `error` is guaranteed.

    Raises
    ------
    InvalidArgumentError
        If an option cannot be used.
    BoundViolationError
        If a mesh is further from the heights than it states, or has a gap; nothing is written.
    CorruptStreamError
        If a block is damaged.
    StorageError
        If something cannot be read or written.
    TerrainwaveError
        If a package is missing.

    Notes
    -----
    Before a file is written, independent code compares its mesh with all decoded heights of the
    area: the mesh is one surface without gaps, and no height is further from it than the mesh's
    error plus the file's bound. `error` includes the rounding of the file's coordinates.
    """
    given = locals()
    n_lods = checked_whole("n_lods", n_lods, least=1, most=MOST_LODS)
    max_error = checked_error("max_error", max_error)
    check_flags(overwrite=overwrite)
    shape = Shape(**{name: given[name] for name in Shape.names()})
    options = vars(shape)
    check_shape(shape, check_extension(dst))
    _refuse_zero(max_error, n_lods)
    paths = [lod_path(dst, number) for number in range(n_lods)]
    for path in paths:
        refuse_own_source(src, path)
        prepare(path, overwrite=overwrite)
    with Terrain(src, threads=threads) as terrain:
        check_drape(terrain, drape)
        region = terrain.checked_window(window, bounds=bounds, level=-1).region

        def made(error: float | None) -> Any:
            return terrain.mesh(
                window, bounds=bounds, max_error=error, optimise=optimise, progress=progress
            )

        meshes = []
        for number, path in enumerate(paths):
            bound = None if max_error is None else max_error * 2**number
            if bound is None:
                mesh = made(None)
                # The next levels get twice the error that this one states, and so on.
                max_error = mesh.error
                _refuse_zero(max_error, n_lods)
            else:
                mesh, is_within = mesh_for_file(made, path, bound, terrain.quanta_error, **options)
                if not is_within:
                    warnings.warn(note_on_rounding(bound), TerrainwaveWarning, stacklevel=2)
            problems, _ = area_problems(terrain, mesh, region, bound)
            if problems:
                raise BoundViolationError(
                    f"LOD {number} is not what it states, and nothing was written: {problems[0]};"
                    " please report this with the file"
                )
            _log.info("LOD %d: %d triangles within %g", number, mesh.n_triangles, mesh.error)
            about = {"lod": number, "n_lods": n_lods}
            meshes.append(replace(mesh, attributes=mesh.attributes | {"about": about}))
    if drape is not None:
        texture = with_texture(meshes[0], drape).attributes["texture"]
        meshes = [
            replace(mesh, attributes=mesh.attributes | {"texture": texture}) for mesh in meshes
        ]
    saved: list[SavedMesh] = []
    for mesh, path in zip(meshes, paths, strict=True):
        if saved and frame == "ecef":
            centre = {"geocentric_centre": saved[0].origin}
            mesh = replace(mesh, attributes=mesh.attributes | centre)
        saved.append(save_mesh(mesh, path, overwrite=overwrite, **options))
    return saved


def _refuse_zero(max_error: float | None, n_lods: int) -> None:
    if max_error == 0 and n_lods > 1:
        raise InvalidArgumentError(
            "found `max_error` 0 for several levels of detail, expected more than 0: the next level"
            " has twice the error of the one before"
        )


def lod_path(path: str | os.PathLike[str], number: int) -> str:
    """Return the file name of a level of detail."""
    whole = Path(path)
    return str(whole.with_name(f"{whole.stem}_lod{number}{whole.suffix}"))
