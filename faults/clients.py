"""The clients of `faults.serving`, in a process of their own.

``python -m faults.clients ADDRESS CLIENTS SLOW SECONDS`` prints JSON: `requests`,
each a kind, milliseconds and status, and `slow`: how many connections slow clients had, and how
many of them the server ended.
"""

import asyncio
import json
import math
import random
import sys
import time
import urllib.request
from collections.abc import Iterator
from typing import NamedTuple
from urllib.parse import urlsplit

# No answer takes longer, or it hangs.
_PATIENCE = 60
# Seconds, as the server asks for.
_RETRY_AFTER = 1
LOST, HUNG = 0, -1


class Asked(NamedTuple):
    """A request: its kind, and its bytes."""

    kind: str
    data: bytes


def ask(kind: str, path: str, *headers: str, method: str = "GET", body: str = "") -> Asked:
    """Return a request of the local server."""
    lines = [f"{method} {path} HTTP/1.1", "Host: 127.0.0.1", *headers, "", body]
    return Asked(kind, "\r\n".join(lines).encode("latin-1"))


def tile_of(terrain: dict, rng: random.Random) -> tuple[int, int, int]:
    """Return z, x, y of a place on a terrain, at one of its six finest zooms."""
    west, south, east, north = terrain["bounds"]
    z = max(0, terrain["maxzoom"] - rng.randrange(6))
    latitude = math.radians(rng.uniform(south, north))
    x = (rng.uniform(west, east) + 180) / 360
    y = (1 - math.asinh(math.tan(latitude)) / math.pi) / 2
    return z, int(x * 2**z) % 2**z, min(max(int(y * 2**z), 0), 2**z - 1)


def asked_of(terrains: list[dict], sizes: dict[str, int], rng: random.Random) -> Iterator[Asked]:
    """Yield requests without end: tiles mostly, as of a map, and one of all else."""
    while True:
        terrain = rng.choice(terrains)
        name = terrain["name"]
        west, south, east, north = terrain["bounds"]
        z, x, y = tile_of(terrain, rng)
        place = f"lon={rng.uniform(west, east)}&lat={rng.uniform(south, north)}"
        rim = rng.choice(("", "?rim=4"))
        start = rng.randrange(sizes[name])
        beyond = "9" * rng.choice((1, 20, 5000))
        yield rng.choices(*zip(*(
            (ask("terrain-RGB tile", f"/{name}/rgb/{z}/{x}/{y}.png{rim}"), 20),
            (ask("tile of voids", f"/{name}/voids/{z}/{x}/{y}.png?color=dbe4e8"), 8),
            (ask("mesh tile", mesh_path(terrain, rng)), 10),
            (ask("height", f"/{name}/height?{place}"), 15),
            (ask("range of the GeoTIFF", f"/{name}.tif", f"Range: bytes={start}-{start + 16383}"),
             10),
            (ask("range of the file", f"/{name}.twz", "Range: bytes=0-16383"), 8),
            (ask("whole file", f"/{name}.twz"), 1),
            (ask("HEAD", f"/{name}.tif", method="HEAD"), 3),
            (ask("catalog", rng.choice(("/terrains.json", f"/{name}/tiles.json",
                                        f"/{name}/mesh/layer.json"))), 8),
            (ask("page", rng.choice(("/", "/static/page.js",
                                     "/static/maplibre/maplibre-gl.js"))), 4),
            (ask("not there", rng.choice(("/none.tif", f"/{name}/rgb/40/0/0.png", "/a/b/c/d",
                                          "/static/../app.py", f"/{name}/rgb/1/9/9.png"))), 6),
            (ask("wrong", rng.choice((f"/{name}/height?lon=nan&lat=0", f"/{name}/rgb/a/b/c.png",
                                      f"/{name}/height?lon={beyond}&lat=1e999",
                                      f"/{name}/rgb/0/0/0.png?rim={beyond}"))), 4),
            (ask("odd range", f"/{name}.twz",
                 f"Range: bytes={rng.choice(('', '-', '7'))}{beyond}-{beyond}"), 2),
            (ask("other host", "/", "Host: evil.example"), 2),
            (Asked("malformed", rng.choice((b"\0\1\2\r\n\r\n", b"GET\r\n\r\n",
                                            b"GET / HTTP/1.1\r\nHost: a/b\r\n\r\n",
                                            b"GET /" + b"x" * 20000 + b" HTTP/1.1\r\n\r\n"))), 2),
            (ask("wrong method", f"/{name}.twz", "Content-Length: 3", method="POST", body="a=b"),
             2),
        ), strict=True))[0]  # fmt: skip


def mesh_path(terrain: dict, rng: random.Random) -> str:
    """Return the address of a quantized-mesh tile at a place on a terrain."""
    west, south, east, north = terrain["bounds"]
    z = max(0, terrain["maxzoom"] - 2 - rng.randrange(5))
    x = int((rng.uniform(west, east) + 180) / 180 * 2**z) % (2 << z)
    y = min(int((rng.uniform(south, north) + 90) / 180 * 2**z), (1 << z) - 1)
    return f"/{terrain['name']}/mesh/{z}/{x}/{y}.terrain"


async def answered(reader: asyncio.StreamReader, *, has_body: bool) -> tuple[int, bool]:
    """Read an answer; return its status, and whether the connection goes on."""
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
    status = int(head.split(" ", 2)[1])
    headers = dict(line.split(": ", 1) for line in head.split("\r\n")[1:] if ": " in line)
    is_kept = headers.get("connection") != "close"
    if has_body and status not in (204, 304):
        if "content-length" in headers:
            await reader.readexactly(int(headers["content-length"]))
        else:
            await reader.read()
            is_kept = False
    return status, is_kept


async def client(place: tuple[str, int], asked: Iterator[Asked], end: float, found: list) -> None:
    """Ask one request after the other, on one connection for as long as it is kept."""
    streams = None
    while time.monotonic() < end:
        request = next(asked)
        began = time.monotonic()
        is_kept = False
        try:
            async with asyncio.timeout(_PATIENCE):
                if streams is None:
                    streams = await asyncio.open_connection(*place)
                reader, writer = streams
                writer.write(request.data)
                status, is_kept = await answered(reader, has_body=request.kind != "HEAD")
        except TimeoutError:
            status = HUNG
        except (OSError, asyncio.IncompleteReadError):
            status = LOST
        found.append((request.kind, round(1000 * (time.monotonic() - began), 2), status))
        if streams is not None and not is_kept:
            streams[1].transport.abort()
            streams = None
        if status == 503:
            await asyncio.sleep(_RETRY_AFTER)


# What slow clients begin with, and send each second: one never reads a large answer, the others
# send headers, a body that nobody wants, or nothing.
_DROPS = (b"G", b"a: b\r\n", b"x", b"")


async def slow(kind: int, place: tuple[str, int], large: str, end: float) -> list[int]:
    """Be slow again and again; return how many connections it had, and how many were ended."""
    begin = (ask("", large).data, b"GET / HTTP/1.1\r\n", ask("", "/", "Content-Length: 99999").data)
    n_begun = n_ended = 0
    while time.monotonic() < end:
        n_begun += 1
        try:
            reader, writer = await asyncio.open_connection(*place, limit=1024)
        except OSError:
            continue
        reading = asyncio.create_task(_read_on(reader)) if kind else None
        writer.write((*begin, b"")[kind])
        has_ended = False
        while time.monotonic() < end and not has_ended:
            await asyncio.sleep(1)
            writer.write(_DROPS[kind])
            has_ended = writer.is_closing() or (reading is not None and reading.done())
        n_ended += has_ended
        if reading is not None:
            reading.cancel()
        writer.transport.abort()
    return [n_begun, n_ended]


async def _read_on(reader: asyncio.StreamReader) -> None:
    """Read until the connection ends, however it does."""
    try:
        while await reader.read(1 << 16):
            pass
    except OSError:
        pass


async def load(address: str, n_clients: int, n_slow: int, seconds: float) -> dict:
    """Run all clients; return what `main` prints."""
    split = urlsplit(address)
    place = split.hostname or "", split.port or 80
    with urllib.request.urlopen(f"{address}terrains.json", timeout=60) as answer:
        terrains = json.load(answer)
    sizes = {}
    for terrain in terrains:
        head = urllib.request.Request(f"{address}{terrain['name']}.tif", method="HEAD")
        with urllib.request.urlopen(head, timeout=60) as answer:
            sizes[terrain["name"]] = int(answer.headers["Content-Length"])
    end = time.monotonic() + seconds
    found: list[tuple[str, float, int]] = []
    large = f"/{terrains[0]['name']}.tif"
    slow_ones = [slow(number % 4, place, large, end) for number in range(n_slow)]
    clients = [
        client(place, asked_of(terrains, sizes, random.Random(number)), end, found)
        for number in range(n_clients)
    ]
    begun_and_ended, *_ = await asyncio.gather(asyncio.gather(*slow_ones), *clients)
    return {"requests": found, "slow": [sum(column) for column in zip(*begun_and_ended)]}


def main() -> None:
    """Print what was found."""
    address, n_clients, n_slow, seconds = sys.argv[1:]
    print(json.dumps(asyncio.run(load(address, int(n_clients), int(n_slow), float(seconds)))))


if __name__ == "__main__":
    main()
