"""The answers to requests: what is asked, checked, goes to the tiles and files of `layers`."""

import math
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import FileResponse, JSONResponse, StreamingResponse

from terrainwave.container.header import MEDIA_TYPE
from terrainwave.ext.serve.catalog import describe
from terrainwave.ext.serve.layers import Layer, Raster, Shelf, named
from terrainwave.ext.serve.locations import Locations, fields_of, locations_of, read_body
from terrainwave.ext.serve.sending import PART, Ahead, Desk, asked_span, begun, is_same, parts
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.terrain_rgb import Look
from terrainwave.globe.tile_scheme import MAX_ZOOM as LAST_MESH_ZOOM

STATIC = Path(__file__).parent / "static"

Rim = Annotated[int, Query(ge=0, le=tiling.MAX_RIM)]

AskedEncoding = Annotated[str | None, Query(alias="encoding", pattern="^(mapbox|terrarium)$")]
AskedVoids = Annotated[str | None, Query(alias="voids", pattern="^(height|transparent)$")]

# How long clients may keep a reply: one whose address names all that it depends on, and any other,
# which they compare with the server's each time.
_FOREVER, _COMPARED = "max-age=31536000, immutable", "no-cache"


def asked_look(look: Look, encoding: str | None, voids: str | None) -> Look:
    is_clear = look.transparent_voids if voids is None else voids == "transparent"
    return Look(encoding or look.encoding, is_clear)


class Answers:
    """Answers from the files of a shelf; a method for each address.

    `desk` has what is decoded, `reading` the bytes of files, which need not wait for that. `look`
    is that of tiles where a request asks for none. `public_url` is the server's address as browsers
    see it; by default that of each request.
    """

    def __init__(
        self,
        layers: dict[str, Layer],
        shelf: Shelf,
        desk: Desk,
        reading: Desk,
        look: Look,
        sea_level: str | float,
        public_url: str | None = None,
    ) -> None:
        self._layers, self._shelf, self._desk, self._reading = layers, shelf, desk, reading
        self._look, self._sea_level, self._public_url = look, sea_level, public_url

    def router(self) -> APIRouter:
        answers: dict[str, Callable[..., Any]] = {
            "/": self._page,
            "/terrains.json": self._terrains,
            "/{name}/tiles.json": self._tiles,
            "/{name}/rgb/{z}/{x}/{y}.png": self._rgb,
            "/{name}/voids/{z}/{x}/{y}.png": self._voids,
            "/{name}/mesh/layer.json": self._layer_json,
            "/{name}/mesh/{z}/{x}/{y}.terrain": self._mesh,
            "/{name}.tif": self._geotiff,
            "/{name}.twz": self._file,
            "/{name}/height": self._heights,
        }
        router = APIRouter()
        for path, answer in answers.items():
            router.add_api_route(path, answer, methods=["GET", "HEAD"])  # RFC 9110, 9.1
        router.add_api_route("/{name}/height", self._heights_posted, methods=["POST"])
        return router

    def _find(self, name: str) -> Layer:
        return named(name, self._layers)

    def _tagged(
        self, request: Request, raster: Raster, of: Look | None = None, *, is_fixed: bool = False
    ) -> dict[str, str]:
        """Return the headers of a reply, of a look if it has one; 304 if the client has it.

        Replies to an address that names their version never change if `is_fixed`: nothing else
        that a server started anew may do otherwise decides about them.
        """
        kind = "" if of in (None, tiling.PLAIN) else f"-{'-'.join(map(str, of))}"
        tag = f'"{raster.version}{kind}"'
        is_kept = is_fixed and request.query_params.get("v") == raster.version
        headers = {"ETag": tag, "Cache-Control": _FOREVER if is_kept else _COMPARED}
        if is_same(request.headers.get("if-none-match", ""), tag):
            raise HTTPException(304, headers=headers)
        return headers

    @cached_property
    def _described(self) -> bytes:
        encoding, sea_level = self._look.encoding, self._sea_level
        layers = self._layers.values()
        found = [
            describe(layer.name, layer.globe, encoding, sea_level) | {"tag": layer.version}
            for layer in layers
        ]
        return bytes(JSONResponse(found).body)

    async def _page(self) -> FileResponse:
        return FileResponse(STATIC / "index.html")

    async def _terrains(self) -> Response:
        return Response(self._described, media_type="application/json")

    async def _tiles(
        self,
        request: Request,
        name: str,
        rim: Rim = 0,
        asked_encoding: AskedEncoding = None,
        voids: AskedVoids = None,
    ) -> dict[str, object]:
        layer = self._find(name)
        url = f"{self._public_url or request.base_url}{name}/rgb/{{z}}/{{x}}/{{y}}.png"
        shown = asked_look(self._look, asked_encoding, voids)
        asked = {"v": layer.version, "encoding": shown.encoding, "voids": shown.voids}
        query = urlencode(asked | ({"rim": str(rim)} if rim else {}))
        return tiling.tile_json(layer.globe, f"{url}?{query}", name, shown.encoding)

    async def _rgb(
        self,
        request: Request,
        name: str,
        z: int,
        x: int,
        y: int,
        rim: Rim = 0,
        asked_encoding: AskedEncoding = None,
        voids: AskedVoids = None,
    ) -> Response:
        layer, shown = self._find(name), asked_look(self._look, asked_encoding, voids)
        check_tile(z, x, y, tiling.MAX_ZOOM)
        is_fixed = asked_encoding is not None and voids is not None
        headers = self._tagged(request, layer, shown, is_fixed=is_fixed)
        tile = await self._desk.do(layer.rgb_tile, z, x, y, rim, shown)
        if tile is None and rim:
            png = tiling.void_tile(layer.globe, shown)
            return Response(png, media_type="image/png", headers=headers)
        if tile is None:
            return Response(status_code=204, headers=headers)
        headers["X-Tile-Error"] = f"{tile.error:.3f}"
        headers["X-Terrain-Error"] = f"{tile.terrain_error:.3f}"
        return Response(tile.image, media_type="image/png", headers=headers)

    async def _voids(
        self,
        request: Request,
        name: str,
        z: int,
        x: int,
        y: int,
        color: Annotated[str, Query(pattern="^[0-9A-Fa-f]{6}$")],
        rim: Rim = 0,
    ) -> Response:
        layer = self._find(name)
        check_tile(z, x, y, tiling.MAX_ZOOM)
        headers = self._tagged(request, layer, is_fixed=True)
        png = await self._desk.do(layer.covering, z, x, y, rim, color, Look(self._look.encoding))
        if png is None:
            return Response(status_code=204, headers=headers)
        return Response(png, media_type="image/png", headers=headers)

    async def _layer_json(self, name: str) -> dict[str, Any]:
        layer = self._find(name)
        return await self._desk.do(partial(layer.tiles.layer, version=layer.version))

    async def _mesh(self, request: Request, name: str, z: int, x: int, y: int) -> Response:
        layer = self._find(name)
        check_tile(z, x, y, LAST_MESH_ZOOM, n_first=2)
        headers = self._tagged(request, layer, is_fixed=True)
        tile = await self._desk.do(layer.tiles.tile, z, x, y)
        if tile is None:
            raise HTTPException(404, f"no tile {z}/{x}/{y}: there is no terrain", headers)
        if tile.error is not None:
            headers["X-Tile-Error"] = f"{tile.surface_error:.3f}"
            headers["X-Terrain-Error"] = f"{tile.error - tile.surface_error:.3f}"
        return Response(tile.data, media_type="application/vnd.quantized-mesh", headers=headers)

    async def _geotiff(self, request: Request, name: str) -> Response:
        raster = self._shelf.find(name)
        made = raster.geotiff
        headers = self._tagged(request, raster)
        return await self._send(
            request, headers, "image/tiff", made.size, made.read_at, self._desk, raster.ahead
        )

    async def _file(self, request: Request, name: str) -> Response:
        raster = self._shelf.find(name)
        source, headers = raster.terrain.container.source, self._tagged(request, raster)
        return await self._send(
            request, headers, MEDIA_TYPE, source.size, source.read, self._reading
        )

    async def _send(
        self,
        request: Request,
        headers: dict[str, str],
        media_type: str,
        size: int,
        read: Callable[[int, int], bytes],
        desk: Desk,
        ahead: Ahead | None = None,
    ) -> Response:
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

    async def _heights(
        self,
        name: str,
        lon: str | None = None,
        lat: str | None = None,
        locations: str | None = None,
        interpolation: str | None = None,
    ) -> Response:
        layer = self._find(name)
        is_one = locations is None and not (lon is None and lat is None)
        asked = [{"latitude": lat, "longitude": lon}] if is_one else locations
        places = locations_of(asked, interpolation)
        found = await self._desk.do(height_at if is_one else heights_at, layer, places)
        return JSONResponse(found)

    async def _heights_posted(self, request: Request, name: str) -> Response:
        layer = self._find(name)
        body = await read_body(request.stream())
        fields = fields_of(body, request.headers.get("content-type", ""))
        places = locations_of(fields.get("locations"), fields.get("interpolation"))
        return JSONResponse(await self._desk.do(heights_at, layer, places))


def check_tile(z: int, x: int, y: int, last_zoom: int, n_first: int = 1) -> None:
    """Answer 404 for a tile outside a pyramid with `n_first` tiles side by side on zoom 0."""
    if not 0 <= z <= last_zoom:
        raise HTTPException(404, f"found zoom {z}, expected 0 … {last_zoom}")
    n_columns, n_rows = n_first << z, 1 << z
    if not (0 <= x < n_columns and 0 <= y < n_rows):
        raise HTTPException(
            404, f"found tile {x}/{y}, expected 0 … {n_columns - 1} / 0 … {n_rows - 1} at zoom {z}"
        )


def heights_at(layer: Layer, places: Locations) -> dict[str, Any]:
    """Return the heights in metres at places, null for voids, and the file's bound.

    Results have the fields of Open-Elevation and of OpenTopoData. `units` is null where nobody
    knows the unit: heights are then as the file has them.
    """
    globe = layer.globe
    heights = globe.sample(*places)
    found = zip(heights.tolist(), places.lat.tolist(), places.lon.tolist(), strict=True)
    return {
        "status": "OK",
        "results": [
            {
                "elevation": None if math.isnan(height) else height,
                "latitude": lat,
                "longitude": lon,
                "location": {"lat": lat, "lng": lon},
                "dataset": layer.name,
            }
            for height, lat, lon in found
        ],
        "max_error": globe.effective_error,
        "units": globe.units,
    }


def height_at(layer: Layer, place: Locations) -> dict[str, Any]:
    found = heights_at(layer, place)
    (result,) = found["results"]
    return {
        "lon": result["longitude"],
        "lat": result["latitude"],
        "height": result["elevation"],
        "max_error": found["max_error"],
        "units": found["units"],
    }
