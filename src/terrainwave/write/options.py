"""`Options`: what `compress` is asked for, checked where it is made and handed on whole."""

from dataclasses import asdict, dataclass, fields
from typing import Any

from terrainwave.arguments import (
    BLOCKS,
    check_choice,
    check_effort,
    check_flags,
    check_mesh,
    check_mesh_of,
    check_method,
    checked_error,
    checked_threads,
    checked_whole,
)
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import (
    DEFAULT_METHOD,
    EFFORTS,
    FORMATS,
    METHODS,
    SMALLEST_METHOD,
    Method,
    methods_that,
    stored_mesh,
)

DEFAULT_EFFORT = "default"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `compress`, which says what they mean; "auto" has become what it stands for.

    Raises
    ------
    InvalidArgumentError
        If one of them, or two together, cannot be; the message says what was found and expected.
    """

    max_error: float | None = None
    rate: float | None = None
    psnr: float | None = None
    method: str = "auto"
    block: int = 256
    effort: str = "default"
    border_rings: int = 1
    mesh: str = "auto"
    mesh_error: float | None = None
    faithful: bool = False
    strict: bool = False
    stable: bool = False
    format: str = FORMATS[-1]
    keep_origin: bool = False
    verify: bool = True
    threads: int | None = None

    def __post_init__(self) -> None:
        settled: dict[str, Any] = {
            "max_error": checked_error("max_error", self.max_error),
            "rate": checked_error("rate", self.rate),
            "psnr": checked_error("psnr", self.psnr),
            "mesh_error": checked_error("mesh_error", self.mesh_error),
            "border_rings": checked_whole("border_rings", self.border_rings, expected="1 or 3"),
        }
        blocks = f"one of {', '.join(map(str, BLOCKS))}"
        settled["block"] = checked_whole("block", self.block, expected=blocks)
        if settled["block"] not in BLOCKS:
            raise InvalidArgumentError(f"found `block` {settled['block']}, expected {blocks}")
        if self.threads is not None:
            settled["threads"] = checked_threads(self.threads)
        flags = [field.name for field in fields(self) if isinstance(field.default, bool)]
        check_flags(**{name: getattr(self, name) for name in flags})
        check_mesh(self.mesh, or_none=True)
        check_method(self.method)
        check_effort(self.effort)
        asked = self.method
        if asked == "auto":
            method = SMALLEST_METHOD if self.effort == EFFORTS[-1] else DEFAULT_METHOD
            settled["method"] = method.name
            if not method.effort:
                settled["effort"] = DEFAULT_EFFORT
        for name, value in settled.items():
            object.__setattr__(self, name, value)
        check_mesh_of(self.mesh, self.named_method, is_faithful=self.faithful)
        mesh = stored_mesh(self.mesh, self.named_method, is_faithful=self.faithful)
        object.__setattr__(self, "mesh", mesh)
        self._check_goals(asked)
        check_choice("format", self.format, FORMATS)
        if self.border_rings not in (1, 3):
            raise InvalidArgumentError(f"found `border_rings` {self.border_rings}, expected 1 or 3")
        if self.border_rings != 1 and self.named_method.is_tiled:
            raise InvalidArgumentError(
                f"found `border_rings` {self.border_rings} and `method` {self.method}, expected"
                " `border_rings` 1"
            )
        if self.faithful and not self.named_method.may_be_faithful:
            fit = methods_that(lambda method: method.may_be_faithful)
            raise InvalidArgumentError(
                f"found `faithful` and `method` {asked}, expected `method` {fit}: the others"
                " follow no paper to the letter"
            )
        if self.stable and self.max_error is None:
            raise InvalidArgumentError(
                "found `stable` without `max_error`, expected both: fixed steps follow from the"
                " bound"
            )
        if self.stable and (self.named_method.is_tiled or self.faithful):
            fit = methods_that(lambda method: not method.is_tiled)
            found = "`faithful`" if self.faithful else f"`method` {asked}"
            raise InvalidArgumentError(
                f"found `stable` and {found}, expected `method` {fit}, and not `faithful`: those"
                " round heights in ways of their own"
            )

    def _check_goals(self, asked: str) -> None:
        """Raise `InvalidArgumentError` unless at most one of three goals is given, and fits.

        `asked` is the method as the user named it.
        """
        goals = {"max_error": self.max_error, "rate": self.rate, "psnr": self.psnr}
        given = [name for name, goal in goals.items() if goal is not None]
        if len(given) > 1:
            names = " and ".join(f"`{name}`" for name in given)
            raise InvalidArgumentError(
                f"found {names}, expected one of them: a stream is cut in one place"
            )
        if not self.is_embedded:
            return
        if self.strict:
            raise InvalidArgumentError(
                f"found `strict` and `{given[0]}`, expected `max_error`: there is no other bound to"
                " keep strictly"
            )
        (name,) = given
        if goals[name] == 0:
            raise InvalidArgumentError(f"found `{name}` 0, expected a number > 0")
        if not self.named_method.is_cuttable:
            fit = methods_that(lambda method: method.is_cuttable)
            raise InvalidArgumentError(
                f"found `{name}` and `method` {asked}, expected `method` {fit}: the others"
                " keep a bound (`max_error`) instead"
            )

    def to_metadata(self) -> dict[str, Any]:
        """Return what files are made differently by, or checked; plain values for JSON."""
        unrelated = ("threads", "keep_origin")
        return {
            name: value
            for name, value in asdict(self).items()
            # By identity: a bound of 0 equals False.
            if name not in unrelated and value is not None and value is not False
        }

    @property
    def named_method(self) -> Method:
        """Return the method that `method` names."""
        return METHODS[self.method]

    @property
    def effort_number(self) -> int:
        """Return the effort as files number it."""
        return EFFORTS.index(self.effort)

    @property
    def is_embedded(self) -> bool:
        """Say whether streams are cut by size or mean error, not by a bound."""
        return self.rate is not None or self.psnr is not None

    @property
    def n_threads(self) -> int:
        """Return how many threads encode."""
        return checked_threads(self.threads)

    @property
    def may_be_new(self) -> bool:
        """Return whether files may use what readers of the first format do not know."""
        return self.format != FORMATS[0]

    @property
    def notes(self) -> list[str]:
        """Return remarks on options that change nothing."""
        if self.effort == DEFAULT_EFFORT:
            return []
        if self.faithful:
            return [f"effort {self.effort} changes nothing: faithful files have one wavelet step"]
        if self.named_method.effort:
            return []
        return [f"effort {self.effort} changes nothing: method {self.method} has no efforts"]
