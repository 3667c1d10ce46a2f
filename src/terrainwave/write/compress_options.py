"""`Options`: the options of `compress`, checked when they are made."""

from dataclasses import dataclass, field, replace
from typing import Any

from terrainwave.arguments import BLOCKS, checked_numbers, checked_threads
from terrainwave.codec.method_options import (
    EFFORT_HELP,
    METHOD_HELP,
    MethodChoice,
    MethodOptions,
    chosen,
    with_method,
)
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import (
    BOTH,
    DEFAULT_EFFORT,
    DEFAULT_MESH,
    EFFORTS,
    MESH_KINDS,
    METHODS,
    SIDES,
    Method,
)
from terrainwave.option_sets import FLAG, Kind, OptionSet, number, numbers, option, whole, words
from terrainwave.tri.mesh_options import MeshOptions, check_mesh, stored_mesh


def _checked_range(name: str, found: Any) -> tuple[float, float]:
    low, high = checked_numbers(name, found, "low,high")
    if low > high:
        raise InvalidArgumentError(
            f"found `{name}` from {low:g} to {high:g}, expected the lower one first"
        )
    return low, high


def _checked_mesh(_: str, mesh: Any) -> Any:
    check_mesh(mesh, or_none=True)
    return mesh


@dataclass(frozen=True, kw_only=True)
class Options(OptionSet):
    """Options of `compress`; its docstring describes them.

    After construction `method` holds the method's own options, and `mesh_kind` the kind of meshes
    that the file gets, as in `names.MESHES`.

    Raises
    ------
    InvalidArgumentError
        If an option, or a combination, is invalid; the message says what was found and expected.
    """

    max_error: float | None = option(
        number(least=0),
        "Largest allowed error, in the raster's vertical unit; 0 is lossless."
        " Default: lossless for heights in whole steps (metres, centimetres, feet), otherwise"
        " 0.01 m, or a 10,000th of the range of heights that span little or are in no unit of"
        " length; a note says which.",
    )
    bound: str = option(
        words(*SIDES),
        "Side of the original on which heights may lie: both; above, where none is below its"
        " original; or below. Up is up, also for depths: with above no depth is deeper than"
        " measured. For the full grid; coarse levels and meshes state errors to both sides.",
        default=BOTH,
    )
    method: str | MethodOptions = option(
        Kind(lambda _, method: method, choices=("auto", *METHODS)),  # checked with the effort
        METHOD_HELP,
        default="auto",
    )
    effort: str = option(words(*EFFORTS), EFFORT_HELP, default=DEFAULT_EFFORT)
    mesh: str | MeshOptions = option(
        Kind(_checked_mesh, choices=(*MESH_KINDS, "none")),
        "Kind of the meshes of all blocks.",
        default="auto",
        typed={"default": DEFAULT_MESH},
    )
    mesh_error: float | None = option(
        number(least=0),
        "Largest distance of the finest meshes from the decoded heights. Default: the guaranteed"
        " error, or the heights' vertical step if that is larger.",
    )
    measure_meshes: bool = option(
        FLAG,
        "Make all meshes and store their distances from the original. Default: an error bound is"
        " computed with each mesh. Kinds other than halves are always measured.",
        default=False,
    )
    height_range: tuple[float, float] | None = option(
        Kind(_checked_range, numbers("low,high").read, "low,high"),
        "Range of heights that later patches may need: patch refuses heights outside it. Default:"
        " the raster's range.",
        typed={"names": ["--range"]},
    )
    strict: bool = option(
        FLAG,
        "Floats with a decimal step (0.01 …): the stored floats are within the bound, not only the"
        " decimal numbers that they stand for. Files become larger.",
        default=False,
    )
    stable: bool = option(
        FLAG,
        "Round heights to fixed steps, which follow from --max-error and the raster's type."
        " Heights then do not change when you decompress them and compress them again with the"
        " same bound. Files become larger.",
        default=False,
    )
    block: int = option(
        whole(*BLOCKS),
        "Cells on each side of a block.",
        default=256,
        typed={"metavar": "32…1024"},
    )
    digest: bool | None = option(
        FLAG,
        "Store digests (SHA-256) of the heights, by which verify finds any change; info prints"
        " their root. Default: yes, unless --no-verify.",
        typed={"names": ["--digest/--no-digest"]},
    )
    verify: bool = option(
        FLAG, "Do not decode and compare every sample; the file says so.", default=True
    )
    keep_origin: bool = option(FLAG, default=False)
    threads: int | None = option(Kind(lambda _, threads: checked_threads(threads)))
    mesh_kind: str = ""
    choice: MethodChoice = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.digest and not self.verify:
            raise InvalidArgumentError(
                "found `digest` without `verify`, expected both: digests are those of heights that"
                " the proof decodes"
            )
        if self.bound != BOTH and (self.strict or self.stable):
            other = "strict" if self.strict else "stable"
            raise InvalidArgumentError(
                f"found `bound` {self.bound} and `{other}`, expected one of them: heights on one"
                " side of their originals are moved from the steps that these keep to"
            )
        choice = chosen(self.method, self.effort)
        kind = self.mesh_kind or stored_mesh(
            self.mesh, choice.own.method, is_faithful=choice.own.is_faithful
        )
        made = {"method": choice.own, "effort": choice.effort, "choice": choice, "mesh_kind": kind}
        for name, value in made.items():
            object.__setattr__(self, name, value)
        if self.stable and self.max_error is None and not choice.own.goal:
            raise InvalidArgumentError(
                "found `stable` without `max_error`, expected both: fixed steps follow from the"
                " bound"
            )
        choice.own.check_beside(self._asked())

    def to_metadata(self) -> dict[str, Any]:
        """Return the options that affect files or the proof, as plain values for JSON."""
        values = self._asked() | {"border_rings": self.border_rings}
        values |= self.choice.own.to_metadata()
        values |= {"method": self.named_method.name, "mesh": self.mesh_kind}
        return {name: values[name] for name in values if name not in ("threads", "keep_origin")}

    def _asked(self) -> dict[str, Any]:
        values = super().to_metadata()
        return {name: values[name] for name in values if values[name] != BOTH}

    def with_method(self, method: Method, mesh: str) -> "Options":
        return replace(self, method=with_method(self.choice.own, method), mesh_kind=mesh)

    @property
    def named_method(self) -> Method:
        return self.choice.own.method

    @property
    def measures_meshes(self) -> bool:
        """Return whether all meshes are made and measured against the original.

        True for stored kinds, and for files that follow a paper, which defines their errors.
        """
        asked = self.measure_meshes or self.faithful or self.mesh_kind != DEFAULT_MESH
        return asked and self.mesh_kind != "none"

    @property
    def border_rings(self) -> int:
        return getattr(self.method, "border_rings", 1)

    @property
    def faithful(self) -> bool:
        return self.choice.own.is_faithful

    @property
    def effort_number(self) -> int:
        return EFFORTS.index(self.effort)

    @property
    def is_embedded(self) -> bool:
        """Return whether streams are cut by size or mean error instead of by a bound."""
        return bool(self.choice.own.goal)

    @property
    def n_threads(self) -> int:
        return checked_threads(self.threads)

    @property
    def makes_digests(self) -> bool:
        return self.verify if self.digest is None else self.digest

    @property
    def notes(self) -> list[str]:
        notes = []
        if self.mesh_error is not None and self.mesh_kind == "none":
            notes.append("the mesh error changes nothing: the file gets no meshes")
        if self.measure_meshes and self.mesh_kind == "none":
            notes.append("measuring meshes changes nothing: the file gets no meshes")
        reason = self.choice.own.without_efforts
        if reason and self.effort != DEFAULT_EFFORT:
            notes.append(f"effort {self.effort} changes nothing: {reason}")
        return notes
