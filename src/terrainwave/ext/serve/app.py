"""The web application: what is asked, checked, goes to `globe.terrain_rgb` and `globe.cesium`.

Only the files named at start are served, and those that `Shelf.add` names. Requests are answered
in threads; at most `n_decoding` of them decode at a time and `sending.N_WAITING` wait,
the rest are told to come back.
"""

import hashlib
import logging
import warnings
from collections.abc import Callable, Iterable
from contextlib import ExitStack, asynccontextmanager
from functools import cache
from itertools import chain, count, islice
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar
from urllib.parse import urlencode

import numpy as np
from fastapi import FastAPI, HTTPException, Query, Request, Response
from fastapi.middleware.cors import CORSMiddleware
from fastapi.responses import FileResponse, JSONResponse, StreamingResponse
from fastapi.routing import APIRoute
from fastapi.staticfiles import StaticFiles
from starlette.datastructures import MutableHeaders
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from terrainwave.arguments import in_one_line
from terrainwave.cache import Cache
from terrainwave.container.header import MEDIA_TYPE
from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.export.virtual_geotiff import VirtualGeoTIFF
from terrainwave.ext.serve.catalog import describe, layer_names
from terrainwave.ext.serve.ranges import asked_span, is_same
from terrainwave.ext.serve.sending import PART, Ahead, Desk, begun, parts
from terrainwave.file import TerrainFile
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.cesium import MAX_ZOOM as LAST_MESH_ZOOM
from terrainwave.globe.cesium import TilePyramid
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.terrain_rgb import Look
from terrainwave.render.look.colorings import AUTO
from terrainwave.render.look.style import check_sea_level

LOCAL_HOSTS = ("127.0.0.1", "localhost", "[::1]")
# Tiles of a file that are kept: the page asks for the heights and the voids of one place.
_N_TILES = 32
_STATIC = Path(__file__).parent / "static"
_log = logging.getLogger(__name__)

# Of a request's address and headers, which answers of 404 and 422 may say again. Browsers send some
# 2 kB.
MAX_REQUEST_BYTES = 16 << 10
# Addresses that are answered in parts.
_RANGED = (".tif", ".twz")

Rim = Annotated[int, Query(ge=0, le=tiling.MAX_RIM)]

AskedEncoding = Annotated[str | None, Query(alias="encoding", pattern="^(mapbox|terrarium)$")]
AskedVoids = Annotated[str | None, Query(alias="voids", pattern="^(height|transparent)$")]

# A page may use what comes with it and nothing else; workers of the map are blobs.
_CONTENT_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline';"
    " script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
# Decoded heights that are kept of all files together, and of one at least.
_CACHE_BYTES, _LEAST_CACHE_BYTES = 512 << 20, 16 << 20
# Names that an answer lists.
_N_NAMES = 10


def asked_look(look: Look, encoding: str | None, voids: str | None) -> Look:
    """Return the look that a request asks for, `look` where it does not say."""
    is_clear = look.transparent_voids if voids is None else voids == "transparent"
    return Look(encoding or look.encoding, is_clear)


class Raster:
    """One file as it is served: the raster, and what names this version of it."""

    def __init__(self, name: str, path: str, cache_bytes: int = 64 << 20) -> None:
        self.name = name
        try:
            self.terrain = TerrainFile(path, cache_bytes=cache_bytes)
        except (InvalidHeightsError, CorruptStreamError) as error:
            raise type(error)(f"{path}: {error}") from error
        self.info = self.terrain.info()
        self.geotiff = VirtualGeoTIFF(self.terrain)
        self.geotiff.warn_of_crs()
        self.ahead = Ahead(self.geotiff.read_at)
        self.tag = hashlib.sha256(repr((name, self.info.n_bytes, self.info)).encode()).hexdigest()


class Layer(Raster):
    """One file with its place on the globe."""

    def __init__(self, name: str, path: str, cache_bytes: int, radius: float | None) -> None:
        super().__init__(name, path, cache_bytes)
        with ExitStack() as stack:
            stack.enter_context(self.terrain)
            try:
                self.globe = Globe(self.terrain, radius=radius)
                self.tiles = TilePyramid(self.globe, void_height=tiling.height_of_voids(self.globe))
            except (InvalidHeightsError, CorruptStreamError) as error:
                raise type(error)(f"{path}: {error}") from error
            stack.pop_all()
        self._rgb_tiles: Cache[tuple[Any, ...], tuple[tiling.RgbTile | None]] = Cache(_N_TILES)

    def rgb_tile(self, z: int, x: int, y: int, rim: int, look: Look) -> tiling.RgbTile | None:
        """Return a terrain-RGB tile; those asked for last are kept, for their voids."""

        # In a tuple: a cache holds no None, which says here that there is no terrain.
        def make() -> tuple[tiling.RgbTile | None]:
            return (tiling.rgb_tile(self.globe, z, x, y, rim, look),)

        (tile,) = self._rgb_tiles.get_or_make((z, x, y, rim, *look), make)
        return tile

    def covering(self, z: int, x: int, y: int, rim: int, color: str, look: Look) -> bytes | None:
        """Return the PNG that paints a tile's voids; None if it has none."""
        tile = self.rgb_tile(z, x, y, rim, look)
        voids = tiling.ALL_VOID if tile is None else tile.voids
        red, green, blue = bytes.fromhex(color)
        return tiling.cover_tile(voids, (red, green, blue)) if voids.any() else None


_Served = TypeVar("_Served", bound=Raster)


def open_layers(paths: list[str], radius: float | None) -> dict[str, Layer]:
    """Return {name in URLs: file} of what can be served; a warning names each file that cannot.

    Raises
    ------
    TerrainwaveError
        What is wrong with the first file, if none can be served.
    InvalidHeightsError
        If two files have the same name.
    """
    layers: dict[str, Layer] = {}
    refused: list[TerrainwaveError] = []
    cache_bytes = max(_CACHE_BYTES // max(len(paths), 1), _LEAST_CACHE_BYTES)
    with ExitStack() as opened:
        for name, path in layer_names(paths).items():
            try:
                layers[name] = Layer(name, path, cache_bytes, radius)
            except TerrainwaveError as error:
                refused.append(error)
                continue
            opened.enter_context(layers[name].globe.terrain)
        if refused and not layers:
            raise refused[0]
        opened.pop_all()
    for reason in refused:
        warnings.warn(TerrainwaveWarning(f"not served: {reason}"), stacklevel=3)
    return layers


class Shelf:
    """Rasters that are served as GeoTIFFs and files, by name; more can be added at any time.

    Parameters
    ----------
    rasters : iterable of Raster
        Those of the start.
    """

    def __init__(self, rasters: Iterable[Raster]) -> None:
        self._rasters = {raster.name: raster for raster in rasters}

    def add(self, path: str) -> Raster:
        """Serve one more file, under a name that no other has; not on the page.

        From one thread at a time. A file that is added again is opened again.

        Raises
        ------
        TerrainwaveError
            If it cannot be opened.
        """
        (stem,) = layer_names([path])
        names = chain([stem], (f"{stem}-{number}" for number in count(2)))
        raster = Raster(next(name for name in names if name not in self._rasters), path)
        # Its head and its coarsest tile are there when a program opens it, and waits.
        raster.geotiff.read_at(raster.geotiff.size - 1, 1)
        self._rasters[raster.name] = raster
        return raster

    def find(self, name: str) -> Raster:
        """Return a raster; `HTTPException` 404 if there is none of that name."""
        return _named(name, self._rasters)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        for raster in self._rasters.values():
            raster.terrain.close()


def _named(name: str, rasters: dict[str, _Served]) -> _Served:
    if name not in rasters:
        listed = [*islice(rasters, _N_NAMES), *(["…"] if len(rasters) > _N_NAMES else [])]
        raise HTTPException(404, f"no terrain {name[:80]!r}; there are: {', '.join(listed)}")
    return rasters[name]


def _guards(*, cors: bool) -> dict[str, str]:
    """Return the headers that say with every answer what a page may do with it."""
    return {
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": _CONTENT_POLICY,
        "Cross-Origin-Resource-Policy": "cross-origin" if cors else "same-origin",
        "Referrer-Policy": "same-origin",
    }


class _Guarded:
    """Sends headers with every answer; takes ranges from requests for what is no raster.

    Starlette would send some hundred pieces of a file of the page, which nobody asks for.

    Not a middleware of Starlette's own kind, through which each part of a body takes longer.
    """

    def __init__(self, app: ASGIApp, guards: dict[str, str]) -> None:
        self._app = app
        self._guards = guards

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(self._guards)
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


class _Route(APIRoute):
    """A route that answers HEAD wherever it answers GET (RFC 9110, 9.1); the server cuts bodies."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        methods: set[str] = self.methods or set()
        if "GET" in methods:
            self.methods = methods | {"HEAD"}


def make_app(
    paths: list[str],
    *,
    hosts: tuple[str, ...] = (),
    cors: bool = False,
    n_decoding: int = 2,
    radius: float | None = None,
    encoding: str = tiling.MAPBOX,
    transparent_voids: bool = False,
    sea_level: str | float = AUTO,
) -> FastAPI:
    """Return the application that serves these files.

    Parameters
    ----------
    paths : list of str
        Paths or URLs of .twz files; ``app.state.shelf`` takes more.
    hosts : tuple of str
        Names that a request's Host header may give besides `LOCAL_HOSTS`.
    cors : bool
        Let pages of other origins read.
    n_decoding : int
        Requests that decode at a time.
    radius : float, optional
        Radius in metres of the body that degrees lie on, instead of the CRS's ellipsoid.
    encoding : {"mapbox", "terrarium"}
        Of terrain-RGB tiles where a request names none, and of the page's; a warning names each
        file with heights that it cannot hold.
    transparent_voids : bool
        Give voids of terrain-RGB tiles alpha 0 where a request does not say.
    sea_level : {"auto", "none"} or float
        Of the page's colours: the height in metres below which all is water, or none; by default 0
        where there are heights below -450 m.

    Raises
    ------
    InvalidHeightsError
        If two files have the same name or none has a place on the globe.
    TerrainwaveError
        If no file can be opened; one that cannot beside others is a warning.
    """
    check_sea_level(sea_level)
    look = Look(tiling.encoding_of(encoding).name, transparent_voids)
    desk = Desk(n_decoding)
    layers = open_layers(paths, radius) if paths else {}
    for layer in layers.values():
        if note := tiling.note_on_range(layer.globe, encoding):
            warnings.warn(TerrainwaveWarning(f"{layer.name}: {note}"), stacklevel=2)
    shelf = Shelf(layers.values())

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> Any:
        with shelf, desk:
            yield

    app = FastAPI(
        title="terrainwave", lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None,
        redirect_slashes=False,
    )  # fmt: skip
    guards = _guards(cors=cors)
    app.router.route_class = _Route
    app.state.layers = layers
    app.state.shelf = shelf
    app.add_middleware(
        TrustedHostMiddleware, allowed_hosts=[*LOCAL_HOSTS, *hosts], www_redirect=False
    )
    if cors:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=["*"],
            allow_methods=["GET", "HEAD"],
            allow_headers=["Range", "If-Range", "If-None-Match"],
            expose_headers=["Accept-Ranges", "Content-Range", "ETag"],
        )

    app.add_middleware(_Guarded, guards=guards)

    @app.exception_handler(TerrainwaveError)
    async def damaged(request: Request, error: TerrainwaveError) -> JSONResponse:
        # A path may have line feeds in it, as %0A.
        _log.warning("%s: %s", in_one_line(request.url.path), in_one_line(error))
        return JSONResponse({"detail": "the file cannot be read there"}, 500)

    @app.exception_handler(Exception)
    async def broken(_request: Request, _error: Exception) -> JSONResponse:
        # The one answer that does not pass through `_Guarded`.
        return JSONResponse({"detail": "internal error"}, 500, guards)

    def find(name: str) -> Layer:
        return _named(name, layers)

    def tagged(request: Request, layer: Raster, of: Look | None = None) -> dict[str, str]:
        """Return the headers of a tile, of a look if it has one; 304 if the client has it."""
        # A server that begins anew may give another look to the same address.
        kind = "" if of in (None, tiling.PLAIN) else f"-{'-'.join(map(str, of))}"
        tag = f'"{layer.tag[:16]}{kind}"'
        headers = {"ETag": tag, "Cache-Control": "max-age=3600"}
        if is_same(request.headers.get("if-none-match", ""), tag):
            raise HTTPException(304, headers=headers)
        return headers

    @cache
    def described() -> bytes:
        found = [
            describe(layer.name, layer.globe, encoding, sea_level) for layer in layers.values()
        ]
        return bytes(JSONResponse(found).body)

    @app.get("/")
    async def page() -> FileResponse:
        return FileResponse(_STATIC / "index.html")

    @app.get("/terrains.json")
    async def terrains() -> Response:
        return Response(described(), media_type="application/json")

    @app.get("/{name}/tiles.json")
    async def tiles(
        request: Request,
        name: str,
        rim: Rim = 0,
        asked_encoding: AskedEncoding = None,
        voids: AskedVoids = None,
    ) -> dict[str, object]:
        layer = find(name)
        url = f"{request.base_url}{name}/rgb/{{z}}/{{x}}/{{y}}.png"
        asked = {"rim": rim or None, "encoding": asked_encoding, "voids": voids}
        query = urlencode({key: value for key, value in asked.items() if value is not None})
        shown = asked_look(look, asked_encoding, voids)
        return tiling.tile_json(
            layer.globe, f"{url}?{query}" if query else url, name, shown.encoding
        )

    @app.get("/{name}/rgb/{z}/{x}/{y}.png")
    async def rgb(
        request: Request,
        name: str,
        z: int,
        x: int,
        y: int,
        rim: Rim = 0,
        asked_encoding: AskedEncoding = None,
        voids: AskedVoids = None,
    ) -> Response:
        layer, shown = find(name), asked_look(look, asked_encoding, voids)
        check_tile(z, x, y, tiling.MAX_ZOOM)
        headers = tagged(request, layer, shown)
        tile = await desk.do(layer.rgb_tile, z, x, y, rim, shown)
        if tile is None and rim:
            png = tiling.void_tile(layer.globe, shown)
            return Response(png, media_type="image/png", headers=headers)
        if tile is None:
            return Response(status_code=204, headers=headers)
        headers["X-Tile-Error"] = f"{tile.error:.3f}"
        headers["X-Terrain-Error"] = f"{tile.terrain_error:.3f}"
        return Response(tile.png, media_type="image/png", headers=headers)

    @app.get("/{name}/voids/{z}/{x}/{y}.png")
    async def voids(
        request: Request,
        name: str,
        z: int,
        x: int,
        y: int,
        color: Annotated[str, Query(pattern="^[0-9A-Fa-f]{6}$")],
        rim: Rim = 0,
    ) -> Response:
        layer = find(name)
        check_tile(z, x, y, tiling.MAX_ZOOM)
        headers = tagged(request, layer)
        png = await desk.do(layer.covering, z, x, y, rim, color, Look(encoding))
        if png is None:
            return Response(status_code=204, headers=headers)
        return Response(png, media_type="image/png", headers=headers)

    @app.get("/{name}/mesh/layer.json")
    async def layer_json(name: str) -> dict[str, Any]:
        return await desk.do(find(name).tiles.layer)

    @app.get("/{name}/mesh/{z}/{x}/{y}.terrain")
    async def mesh(request: Request, name: str, z: int, x: int, y: int) -> Response:
        layer = find(name)
        check_tile(z, x, y, LAST_MESH_ZOOM, n_first=2)
        headers = tagged(request, layer)
        tile = await desk.do(layer.tiles.tile, z, x, y)
        if tile is None:
            raise HTTPException(404, f"no tile {z}/{x}/{y}: there is no terrain", headers)
        if tile.error is not None:
            headers["X-Tile-Error"] = f"{tile.surface_error:.3f}"
            headers["X-Terrain-Error"] = f"{tile.error - tile.surface_error:.3f}"
        return Response(tile.data, media_type="application/vnd.quantized-mesh", headers=headers)

    @app.get("/{name}.tif")
    async def geotiff(request: Request, name: str) -> Response:
        raster = shelf.find(name)
        size = await desk.do(lambda: raster.geotiff.size)
        headers = tagged(request, raster)
        read = raster.geotiff.read_at
        return await send(request, headers, "image/tiff", size, read, raster.ahead)

    @app.get("/{name}.twz")
    async def file(request: Request, name: str) -> Response:
        raster = shelf.find(name)
        source = raster.terrain.container.source
        return await send(request, tagged(request, raster), MEDIA_TYPE, source.size, source.read)

    async def send(
        request: Request,
        headers: dict[str, str],
        media_type: str,
        size: int,
        read: Callable[[int, int], bytes],
        ahead: Ahead | None = None,
    ) -> Response:
        """Return the bytes that are asked for of a resource, or what HEAD wants to know."""
        span = asked_span(request.headers, size, headers["ETag"])
        if span is None:
            return Response(status_code=416, headers=headers | {"Content-Range": f"bytes */{size}"})
        headers |= span.headers
        status = 206 if span.is_part else 200
        if request.method == "HEAD":
            return Response(status_code=status, headers=headers, media_type=media_type)
        if span.stop - span.start <= PART:
            body = await desk.do(read, span.start, span.stop - span.start)
            return Response(body, status, headers, media_type)
        made = await begun(parts(desk, read, span, ahead))
        return StreamingResponse(made, status, headers, media_type)

    @app.get("/{name}/height")
    async def height(
        name: str,
        lon: Annotated[float, Query(ge=-720, le=720)],
        lat: Annotated[float, Query(ge=-90, le=90)],
    ) -> dict[str, float | None]:
        layer = find(name)
        return await desk.do(height_at, layer, lon, lat)

    app.mount("/static", StaticFiles(directory=_STATIC), name="static")
    return app


def check_tile(z: int, x: int, y: int, last_zoom: int, n_first: int = 1) -> None:
    """Refuse an address outside a tile pyramid with `n_first` tiles, side by side, on zoom 0.

    Raises
    ------
    HTTPException
        404, with one line that says what is expected.
    """
    if not 0 <= z <= last_zoom:
        raise HTTPException(404, f"found zoom {z}, expected 0 … {last_zoom}")
    n_columns, n_rows = n_first << z, 1 << z
    if not (0 <= x < n_columns and 0 <= y < n_rows):
        raise HTTPException(
            404, f"found tile {x}/{y}, expected 0 … {n_columns - 1} / 0 … {n_rows - 1} at zoom {z}"
        )


def height_at(layer: Layer, longitude: float, latitude: float) -> dict[str, float | None]:
    """Return the height in metres at a place, null where there is none, and the file's bound."""
    globe = layer.globe
    rows, cols = globe.to_samples(np.array([longitude]), np.array([latitude]))
    heights, _ = globe.heights_at(rows, cols, globe.terrain.grid.k_max)
    height = float(heights[0])
    return {
        "lon": longitude,
        "lat": latitude,
        "height": None if np.isnan(height) else height,
        "max_error": globe.effective_error,
    }
