"""Log of the server: one line for each damaged place, not one for each request that meets it."""

import logging
from functools import lru_cache

_log = logging.getLogger(__name__)


@lru_cache(1000)
def warn_once(line: str) -> None:
    _log.warning("%s", line)
