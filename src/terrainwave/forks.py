"""What the child of a fork must begin anew: it has no thread but one, and locks as they were."""

import os
import weakref
from typing import Protocol


class Renewable(Protocol):
    """Something shared by threads."""

    def renew(self) -> None:
        """Forget threads that are gone, what they waited for and the locks that they held."""


_known: "weakref.WeakSet[Renewable]" = weakref.WeakSet()


def renew_after_fork(thing: Renewable) -> None:
    """Call `thing.renew()` in the child of every fork from now on, as long as it lives."""
    _known.add(thing)


def _renew_all() -> None:
    for thing in list(_known):
        thing.renew()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_all)
