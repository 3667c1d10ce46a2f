"""What every answer says of its use, and which requests are too long to be answered."""

from fastapi.responses import JSONResponse
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

# Of a request's address and headers, which answers of 404 and 422 may say again. Browsers send some
# 2 kB.
MAX_REQUEST_BYTES = 16 << 10
# Addresses that are answered in parts.
_RANGED = (".tif", ".twz")

# A page may use what comes with it and nothing else; workers of the map are blobs.
_CONTENT_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline';"
    " script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


def guards_of(*, cors: bool) -> dict[str, str]:
    """Return the headers that say with every answer what a page may do with it."""
    return {
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": _CONTENT_POLICY,
        "Cross-Origin-Resource-Policy": "cross-origin" if cors else "same-origin",
        "Referrer-Policy": "same-origin",
    }


class Guarded:
    """Sends headers with every answer; takes ranges from requests for what is no raster.

    Starlette would send some hundred pieces of a file of the page, which nobody asks for.

    Not a middleware of Starlette's own kind, through which each part of a body takes longer.
    """

    def __init__(self, app: ASGIApp, guards: dict[str, str]) -> None:
        self._app = app
        self._guards = guards

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, as ASGI has it."""

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update(self._guards)
                # A server started anew may have another page and other terrains.
                headers.setdefault("Cache-Control", "no-cache")
            await send(message)

        if scope["type"] == "http":
            if _n_bytes(scope) > MAX_REQUEST_BYTES:
                answer = JSONResponse({"detail": "the request is too long"}, 431, self._guards)
                await answer(scope, receive, send)
                return
            if not scope["path"].endswith(_RANGED):
                scope["headers"] = [item for item in scope["headers"] if item[0] != b"range"]
        await self._app(scope, receive, send_guarded)


def _n_bytes(scope: Scope) -> int:
    """Return the length of a request's address and headers."""
    headers = sum(len(name) + len(value) for name, value in scope["headers"])
    return len(scope["path"]) + len(scope["query_string"]) + headers
