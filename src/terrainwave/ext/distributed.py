"""Clusters of dask.distributed for `compress`; needs the extra ``distributed``.

`compress` takes any client that `write.tasks.workers.executor_of` supports, so this module only
connects and checks the workers.
"""

import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from terrainwave._version import __version__
from terrainwave.errors import ClusterError
from terrainwave.extras import need

_TIMEOUT = 15.0  # seconds


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """Yield a client of the scheduler at `address`, such as ``tcp://10.0.0.5:8786``.

    Raises `ClusterError` if nothing answers, or the workers are missing or have another
    terrainwave.
    """
    distributed = need("distributed", extra="distributed", purpose="a cluster")
    addressing = need("distributed.comm.addressing", extra="distributed", purpose="a cluster")
    try:
        # A client that fails to connect prints a traceback when it is collected.
        socket.create_connection(addressing.get_address_host_port(address), _TIMEOUT).close()
        client = distributed.Client(address, timeout=_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ClusterError(
            f"no dask scheduler answers at {address}; expected the address that dask scheduler"
            " prints, such as tcp://10.0.0.5:8786"
        ) from error
    try:
        check_workers(client)
        yield client
    finally:
        with _without_closed_connections():
            client.close()


@contextmanager
def _without_closed_connections() -> Iterator[None]:
    """Suppress tornado's tracebacks for results still on their way when a client is closed."""

    def is_other(record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        return type(error).__name__ != "CommClosedError"

    log = logging.getLogger("tornado.application")
    log.addFilter(is_other)
    try:
        yield
    finally:
        log.removeFilter(is_other)


def check_workers(client: Any) -> None:
    """Raise `ClusterError` without workers, or with another terrainwave: perhaps other bytes."""
    versions = client.run(worker_version, on_error="return")
    if not versions:
        raise ClusterError("the cluster has no workers: start some with dask worker")
    for worker, version in versions.items():
        if version != __version__:
            theirs = version if isinstance(version, str) else "none that can be imported"
            raise ClusterError(
                f"the worker {worker} has terrainwave {theirs}, expected {__version__}: install the"
                " same version everywhere"
            )


def worker_version() -> str:
    return __version__
