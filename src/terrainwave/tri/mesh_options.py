"""Options of kinds of meshes, and the kinds that files store."""

from dataclasses import dataclass
from typing import cast

from terrainwave.arguments import check_choice, shown
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import DEFAULT_MESH, MESH_KINDS, Method
from terrainwave.option_sets import OptionSet, set_at


@dataclass(frozen=True, kw_only=True)
class MeshOptions(OptionSet):
    """Options of one kind of meshes."""

    argument = "mesh"

    def stored(self, method: Method, *, is_faithful: bool) -> str:
        """Return the kind of meshes that a file of a method holds, one of `names.MESHES`.

        `is_faithful`: it codes the zero trees of Yusov & Turlapov 2010. Raises
        `InvalidArgumentError` if the file lacks the data that the kind follows.
        """
        raise NotImplementedError


def options_of(name: str) -> type[MeshOptions] | None:
    """Return the class of the options of a kind of meshes; None for one without."""
    place = MESH_KINDS.get(name)
    return cast(type[MeshOptions], set_at(f"terrainwave.tri.{place}")) if place else None


def check_mesh(mesh: object, *, or_none: bool) -> None:
    """Check a kind of meshes; "none" is only valid with `or_none`."""
    if isinstance(mesh, MeshOptions):
        return
    if not isinstance(mesh, str):
        examples = [kind().call() for name in MESH_KINDS if (kind := options_of(name)) is not None]
        raise InvalidArgumentError(
            f"found `mesh` {shown(mesh)}, expected a name, such as {DEFAULT_MESH!r}, or options of"
            f" a kind of meshes, such as {examples[0]}"
        )
    check_choice("mesh", mesh, ("auto", *MESH_KINDS, *["none"] * or_none))


def stored_mesh(mesh: str | MeshOptions, method: Method, *, is_faithful: bool) -> str:
    """Return the kind of meshes that a file of a method stores for `mesh`."""
    if isinstance(mesh, str):
        kind = options_of(mesh)
        if kind is None:
            return DEFAULT_MESH if mesh == "auto" else mesh
        mesh = kind()
    return mesh.stored(method, is_faithful=is_faithful)
