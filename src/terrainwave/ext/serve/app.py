"""The web application: `answers` from `layers`, within `guards`.

Only the files named at start are served, and those that `Shelf.add` names. Requests are answered
in threads; at most `n_decoding` of them decode at a time, and `_N_READING` others read bytes of
files; `sending.N_WAITING` of either kind wait, the rest get 503 with a time to retry.
"""

import warnings
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI, Request
from fastapi.middleware.cors import CORSMiddleware
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.middleware.trustedhost import TrustedHostMiddleware

from terrainwave.arguments import AS_IS, in_one_line
from terrainwave.errors import TerrainwaveError, TerrainwaveWarning
from terrainwave.ext.serve.answers import STATIC, Answers
from terrainwave.ext.serve.layers import Shelf, open_layers
from terrainwave.ext.serve.locations import BadLocationsError
from terrainwave.ext.serve.log import warn_once
from terrainwave.ext.serve.proxies import Guarded, Proxied, guards_of, network_of
from terrainwave.ext.serve.proxies import public_url as address_of
from terrainwave.ext.serve.sending import Desk
from terrainwave.extras import with_extra
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.place.vertical import note_as_is
from terrainwave.render.look.colorings import AUTO, SEA_LEVEL

# Requests for bytes of files that are read at a time: from disk, or from a server, which is slow.
_N_READING = 4
LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]")


@with_extra("serve")
def make_app(
    paths: list[str],
    *,
    hosts: tuple[str, ...] = (),
    cors: bool = False,
    n_decoding: int = 2,
    radius: float | None = None,
    vertical: str = AS_IS,
    encoding: str = tiling.MAPBOX,
    transparent_voids: bool = False,
    sea_level: str | float = AUTO,
    public_url: str | None = None,
    proxy: tuple[str, ...] = (),
) -> FastAPI:
    """Return the application that serves these files; ``app.state.shelf`` takes more.

    Options are those of the command: `hosts` is its --allow-host, `n_decoding` its --threads.
    Raises `TerrainwaveError` if an option has none of its values, two files have the same name or
    none can be opened; one that cannot beside others is a warning.
    """
    SEA_LEVEL.checked("sea_level", sea_level)
    public = None if public_url is None else address_of(public_url)
    networks = [network_of(address) for address in proxy]
    allowed = [*LOCAL_HOSTS, *hosts, *([] if public is None else [public.host])]
    look = tiling.look_of(encoding=encoding, transparent_voids=transparent_voids)
    desk, reading = Desk(n_decoding), Desk(_N_READING)
    layers = open_layers(paths, radius, vertical) if paths else {}
    for layer in layers.values():
        if vertical == AS_IS and not layer.terrain.height_unit.is_radius:
            note_as_is(layer.terrain.crs)
        if note := tiling.note_on_range(layer.globe, encoding):
            warnings.warn(TerrainwaveWarning(f"{layer.name}: {note}"), stacklevel=2)
    shelf = Shelf(layers.values())

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> Any:
        with shelf, desk, reading:
            yield

    app = FastAPI(
        title="terrainwave", lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None,
        redirect_slashes=False,
    )  # fmt: skip
    guards = guards_of(cors=cors)
    app.state.layers = layers
    app.state.shelf = shelf
    # Twice: a page that reaches this server by a name of its own could forward another one.
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=allowed, www_redirect=False)
    app.add_middleware(Proxied, proxies=networks)
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=allowed, www_redirect=False)
    if cors:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=["*"],
            allow_methods=["GET", "HEAD", "POST"],
            allow_headers=["Range", "If-Range", "If-None-Match", "Content-Type"],
            expose_headers=["Accept-Ranges", "Content-Range", "ETag"],
        )

    app.add_middleware(Guarded, guards=guards)

    @app.exception_handler(TerrainwaveError)
    async def damaged(request: Request, error: TerrainwaveError) -> JSONResponse:
        # A path may have line feeds in it, as %0A.
        warn_once(in_one_line(f"{request.path_params.get('name')}: {error}"))
        return JSONResponse({"detail": "the file cannot be read there"}, 500)

    @app.exception_handler(BadLocationsError)
    async def refused(_request: Request, error: Exception) -> JSONResponse:
        return JSONResponse({"status": "INVALID_REQUEST", "error": str(error)}, 400)

    @app.exception_handler(Exception)
    async def broken(_request: Request, _error: Exception) -> JSONResponse:
        # The one answer that does not pass through `Guarded`.
        return JSONResponse({"detail": "internal error"}, 500, guards)

    address = None if public is None else public.address
    app.include_router(Answers(layers, shelf, desk, reading, look, sea_level, address).router())
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    return app
