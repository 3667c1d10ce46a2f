"""Which cases of a parameter `make test` takes; `make test-all` takes all."""

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
