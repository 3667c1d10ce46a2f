"""Cases of one of several parameters that `make test` takes; of all together: the mark `few`."""

import pytest


def some(cases, every):
    """Return all cases, with all but each `every`-th (0, every, …) marked `full`."""
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=pytest.mark.full if i % every else [],
        )
        for i, case in enumerate(cases)
    ]
