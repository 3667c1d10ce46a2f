"""A server between a page and `terrainwave serve` that holds answers back or spoils them."""

import asyncio
import threading

from starlette.responses import PlainTextResponse


class Gate:
    """An ASGI application: `app`, but for paths that begin as `held` and `broken` say."""

    def __init__(self, app):
        self.app = app
        self._held, self._stopped, self._lock = (), [], threading.Lock()
        self.broken = ()
        self.n_waiting = 0

    @property
    def held(self):
        """Beginnings of paths whose answers are held back."""
        return self._held

    @held.setter
    def held(self, paths):
        with self._lock:
            self._held, stopped, self._stopped = paths, self._stopped, []
        for loop, event in stopped:  # they look again
            loop.call_soon_threadsafe(event.set)

    async def _pass(self, path):
        while True:
            with self._lock:
                if not (self._held and path.startswith(self._held)):
                    return
                event = asyncio.Event()
                self._stopped.append((asyncio.get_running_loop(), event))
            await event.wait()

    async def __call__(self, scope, receive, send):
        path = scope.get("path", "")
        self.n_waiting += 1
        await self._pass(path)
        self.n_waiting -= 1
        if self.broken and path.startswith(self.broken):
            await PlainTextResponse("spoilt", 500)(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    def open(self):
        """Let all pass from now on."""
        self.held, self.broken = (), ()
