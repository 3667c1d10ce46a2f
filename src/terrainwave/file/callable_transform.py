"""What `Terrain.transform` returns while calls of it go on working."""

import warnings
from collections.abc import Callable
from typing import Any, Self

from affine import Affine

from terrainwave.grid.affine import Transform


class CallableTransform(Affine):
    """A transform that can be called, as the method `Terrain.transform` of 1.0; until 2.0.

    It equals an Affine of the same numbers, and is pickled as one.
    """

    @classmethod
    def made(cls, transform: Transform, of: Callable[..., Affine]) -> Self:
        """Return a transform whose calls are answered by `of`."""
        a, b, c, d, e, f = transform
        made = cls(a, b, c, d, e, f)
        object.__setattr__(made, "of", of)
        return made

    def __call__(self, level: int = -1, window: Any = None) -> tuple[float, ...]:
        """Return the six numbers of `transform_of`, with a DeprecationWarning."""
        warnings.warn(
            "Terrain.transform is an Affine and no method any more: use transform_of(level, window)"
            " for levels and windows; it cannot be called from 2.0 on",
            DeprecationWarning,
            stacklevel=2,
        )
        of: Callable[..., Affine] = self.__dict__["of"]
        return tuple(of(level, window))[:6]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Affine) and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash(Affine(*self))

    def __reduce__(self) -> tuple[Any, ...]:
        return Affine, tuple(self)
