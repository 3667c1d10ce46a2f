"""Reset of shared objects in the child of a fork, which has one thread and copies of held locks."""

import os
import weakref
from typing import Protocol


class Renewable(Protocol):
    """Object shared by threads."""

    def renew(self) -> None:
        """Forget threads that no longer exist, their pending work and their locks."""


_known: "weakref.WeakSet[Renewable]" = weakref.WeakSet()


def renew_after_fork(thing: Renewable) -> None:
    """Call `thing.renew()` in the child of every later fork, as long as the object lives."""
    _known.add(thing)


def _renew_all() -> None:
    for thing in list(_known):
        thing.renew()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_all)
