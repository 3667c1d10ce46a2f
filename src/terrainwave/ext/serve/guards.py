"""Headers that every answer has, and ranges of rasters only."""

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# Addresses that are answered in parts.
_RANGED = (".tif", ".twz")

# A page may use what comes with it and nothing else; workers of the map are blobs.
_CONTENT_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline';"
    " script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


def guards_of(*, cors: bool) -> dict[str, str]:
    return {
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": _CONTENT_POLICY,
        "Cross-Origin-Resource-Policy": "cross-origin" if cors else "same-origin",
        "Referrer-Policy": "same-origin",
    }


class Guarded:
    """Sends headers with every answer; takes ranges from requests for what is no raster.

    Starlette would send some hundred pieces of a file of the page. Through a middleware of its own
    kind each part of a body takes longer.
    """

    def __init__(self, app: ASGIApp, guards: dict[str, str]) -> None:
        self._app = app
        self._guards = guards

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(self._guards)
                # A server started anew may have another page and other terrains.
                headers.setdefault("Cache-Control", "no-cache")
            await send(message)

        if scope["type"] == "http" and not scope["path"].endswith(_RANGED):
            scope["headers"] = [item for item in scope["headers"] if item[0] != b"range"]
        await self._app(scope, receive, send_guarded)
