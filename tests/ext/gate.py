"""A server between a page and `terrainwave serve` that holds answers back or spoils them."""

import asyncio

from starlette.responses import PlainTextResponse


class Gate:
    """An ASGI application: `app`, but for paths that begin as `held` and `broken` say."""

    def __init__(self, app):
        self.app = app
        self.held = ()
        self.broken = ()
        self.n_waiting = 0

    async def __call__(self, scope, receive, send):
        path = scope.get("path", "")
        self.n_waiting += 1
        while self.held and path.startswith(self.held):
            await asyncio.sleep(0.02)
        self.n_waiting -= 1
        if self.broken and path.startswith(self.broken):
            await PlainTextResponse("spoilt", 500)(scope, receive, send)
        else:
            await self.app(scope, receive, send)

    def open(self):
        """Let all pass from now on."""
        self.held, self.broken = (), ()
