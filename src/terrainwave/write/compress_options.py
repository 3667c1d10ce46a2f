"""`Options`: the options of `compress`, checked when they are made."""

from dataclasses import dataclass, field, fields, replace
from typing import Any

from terrainwave.arguments import (
    BLOCKS,
    check_flags,
    checked_error,
    checked_number,
    checked_threads,
    checked_whole,
    shown,
)
from terrainwave.codec.method_options import MethodChoice, MethodOptions, chosen, with_method
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import DEFAULT_EFFORT, DEFAULT_MESH, EFFORTS, Method, methods_that
from terrainwave.tri.mesh_options import MeshOptions, check_mesh, stored_mesh


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `compress`; its docstring describes them.

    After construction `method` holds the method's own options, and `mesh_kind` the kind of meshes
    that the file gets, as in `names.MESHES`.

    Raises
    ------
    InvalidArgumentError
        If an option, or a combination, is invalid; the message says what was found and expected.
    """

    max_error: float | None = None
    method: str | MethodOptions = "auto"
    block: int = 256
    effort: str = DEFAULT_EFFORT
    mesh: str | MeshOptions = "auto"
    mesh_error: float | None = None
    measure_meshes: bool = False
    height_range: tuple[float, float] | None = None
    strict: bool = False
    stable: bool = False
    keep_origin: bool = False
    digest: bool | None = None
    verify: bool = True
    threads: int | None = None
    mesh_kind: str = ""
    choice: MethodChoice = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        blocks = f"one of {', '.join(map(str, BLOCKS))}"
        checked: dict[str, Any] = {
            "max_error": checked_error("max_error", self.max_error),
            "mesh_error": checked_error("mesh_error", self.mesh_error),
            "block": checked_whole("block", self.block, expected=blocks),
        }
        if self.height_range is not None:
            checked["height_range"] = _checked_range(self.height_range)
        if checked["block"] not in BLOCKS:
            raise InvalidArgumentError(f"found `block` {checked['block']}, expected {blocks}")
        if self.threads is not None:
            checked["threads"] = checked_threads(self.threads)
        flags = [field.name for field in fields(self) if isinstance(field.default, bool)]
        check_flags(**{name: getattr(self, name) for name in flags})
        if self.digest is not None:
            check_flags(digest=self.digest)
        if self.digest and not self.verify:
            raise InvalidArgumentError(
                "found `digest` without `verify`, expected both: digests are those of heights that"
                " the proof decodes"
            )
        choice = chosen(self.method, self.effort)
        checked |= {"method": choice.own, "effort": choice.effort, "choice": choice}
        if not self.mesh_kind:
            check_mesh(self.mesh, or_none=True)
            checked["mesh_kind"] = stored_mesh(
                self.mesh, choice.own.method, is_faithful=getattr(choice.own, "faithful", False)
            )
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        self._check_goals()

    def _check_goals(self) -> None:
        """Raise `InvalidArgumentError` unless at most one of three goals is given, and fits."""
        cuts = [name for name in ("rate", "psnr") if getattr(self, name) is not None]
        if cuts and self.max_error is not None:
            raise InvalidArgumentError(
                f"found `max_error` and `{cuts[0]}`, expected one of them: a stream is cut in one"
                " place"
            )
        if cuts and self.strict:
            raise InvalidArgumentError(
                f"found `strict` and `{cuts[0]}`, expected `max_error`: there is no other bound to"
                " keep strictly"
            )
        if cuts and self.height_range is not None:
            raise InvalidArgumentError(
                f"found `height_range` and `{cuts[0]}`, expected one of them: streams that are cut"
                " cannot be patched"
            )
        if not self.stable:
            return
        if self.max_error is None:
            raise InvalidArgumentError(
                "found `stable` without `max_error`, expected both: fixed steps follow from the"
                " bound"
            )
        if self.named_method.is_tiled or self.faithful:
            fit = methods_that(lambda method: not method.is_tiled)
            found = "`faithful`" if self.faithful else f"`method` {self.named_method.name}"
            raise InvalidArgumentError(
                f"found `stable` and {found}, expected `method` {fit}, and not `faithful`: those"
                " round heights in ways of their own"
            )

    def to_metadata(self) -> dict[str, Any]:
        """Return the options that affect files or the proof, as plain values for JSON."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.init}
        values |= {name: getattr(self, name) for name in _OF_METHODS}
        values |= {"method": self.named_method.name, "mesh": values.pop("mesh_kind")}
        return {
            name: value
            for name, value in values.items()
            # Compared by identity: a bound of 0 equals False.
            if name not in ("threads", "keep_origin") and value is not None and value is not False
        }

    def with_method(self, method: Method, mesh: str) -> "Options":
        """Return the options with another method and other stored meshes."""
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
        """Return the number of rings of samples that neighbouring blocks share."""
        return getattr(self.method, "border_rings", 1)

    @property
    def faithful(self) -> bool:
        """Return whether the file follows its method's paper."""
        return getattr(self.method, "faithful", False)

    @property
    def rate(self) -> float | None:
        """Return the goal in bits per sample, if any."""
        return getattr(self.method, "rate", None)

    @property
    def psnr(self) -> float | None:
        """Return the goal in decibels, if any."""
        return getattr(self.method, "psnr", None)

    @property
    def effort_number(self) -> int:
        """Return the effort as files number it."""
        return EFFORTS.index(self.effort)

    @property
    def is_embedded(self) -> bool:
        """Return whether streams are cut by size or mean error instead of by a bound."""
        return self.rate is not None or self.psnr is not None

    @property
    def n_threads(self) -> int:
        """Return the number of threads that encode."""
        return checked_threads(self.threads)

    @property
    def makes_digests(self) -> bool:
        """Return whether the file gets digests of its heights."""
        return self.verify if self.digest is None else self.digest

    @property
    def notes(self) -> list[str]:
        """Return remarks on options without effect."""
        notes = []
        if self.mesh_error is not None and self.mesh_kind == "none":
            notes.append("the mesh error changes nothing: the file gets no meshes")
        if self.measure_meshes and self.mesh_kind == "none":
            notes.append("measuring meshes changes nothing: the file gets no meshes")
        if self.effort == DEFAULT_EFFORT:
            return notes
        if self.faithful:
            return [
                *notes,
                f"effort {self.effort} changes nothing: faithful files have one wavelet step",
            ]
        if self.named_method.effort:
            return notes
        return [
            *notes,
            f"effort {self.effort} changes nothing: method {self.named_method.name} has no efforts",
        ]


# Options of methods that `to_metadata` adds to the fields of `Options`.
_OF_METHODS = ("rate", "psnr", "border_rings", "faithful")


def _checked_range(found: Any) -> tuple[float, float]:
    """Return the lowest and the highest height that the file must be able to hold.

    Raises
    ------
    InvalidArgumentError
        If they are not two finite numbers in this order.
    """
    if not isinstance(found, tuple | list) or len(found) != 2:
        raise InvalidArgumentError(
            f"found `height_range` {shown(found)}, expected the lowest and the highest height"
        )
    low, high = (checked_number("height_range", end) for end in found)
    if low > high:
        raise InvalidArgumentError(
            f"found `height_range` from {low:g} to {high:g}, expected the lower one first"
        )
    return low, high
