"""Servers in a thread of this process."""

import threading
from contextlib import contextmanager


@contextmanager
def running(server):
    """Yield a server of `socketserver` while it answers; close it at the end."""
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
