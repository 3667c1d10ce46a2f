"""A plain web server of a folder, with byte ranges or without, that notes what it is asked for."""

import contextlib
import re
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from servers import running

# Endings that hosts know: nginx's table (since 2004), for one, lacks `.mjs`.
KNOWN = {
    ".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json",
    ".png": "image/png", ".jpg": "image/jpeg",
}  # fmt: skip


class Handler(SimpleHTTPRequestHandler):
    """Answers requests of ranges as the server is told to."""

    def guess_type(self, path):
        return self.server.types.get(Path(path).suffix, "application/octet-stream")

    def do_GET(self):
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        path = Path(self.translate_path(self.path))
        with self.server.lock:
            self.server.asked.append((self.path, asked and tuple(map(int, asked.groups()))))
        if not (asked and self.server.has_ranges and path.is_file()):
            super().do_GET()
            return
        data = path.read_bytes()
        first, last = int(asked[1]), min(int(asked[2]), len(data) - 1)
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
        self.send_header("Content-Length", str(last + 1 - first))
        self.end_headers()
        with contextlib.suppress(ConnectionError):
            self.wfile.write(data[first : last + 1])

    def end_headers(self):
        for name, value in self.server.headers.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, *_):
        pass


@contextlib.contextmanager
def static_server(folder, *, has_ranges=True, headers=None, types=KNOWN):
    """Yield a server: `address`, and `asked`, a list of paths with ranges or None.

    Every reply has the `headers`. Files with other endings than those in `types` are sent as
    application/octet-stream.
    """
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    server.asked, server.has_ranges, server.lock = [], has_ranges, threading.Lock()
    server.headers, server.types = headers or {}, types
    server.address = f"http://127.0.0.1:{server.server_address[1]}"
    with running(server):
        yield server
