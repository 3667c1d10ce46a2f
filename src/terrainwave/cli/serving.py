"""The command that answers over HTTP: serve."""

import json
import socket
import threading
import webbrowser
from collections.abc import Callable
from typing import Any

import click

from terrainwave.arguments import count_of
from terrainwave.cli.commands import main, plain_json
from terrainwave.cli.options import NamedInput, Positive
from terrainwave.cli.output import announce_compiling, message_of, print_note
from terrainwave.cli.signals import Terminated
from terrainwave.errors import StorageError, TerrainwaveError
from terrainwave.extras import need


@main.command()
@click.argument("files", nargs=-1, type=NamedInput())
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), default=8765, show_default=True,
              help="0 takes a free one.")  # fmt: skip
@click.option("--allow-host", "hosts", multiple=True, metavar="NAME",
              help="Name it may be asked by, besides localhost.")  # fmt: skip
@click.option("--cors", is_flag=True, help="Let pages of other sites read the tiles.")
@click.option("--threads", "n_decoding", type=click.IntRange(1, 64), default=2, show_default=True,
              help="Requests that decode at a time.")  # fmt: skip
@click.option("--radius", type=Positive(), help="Of the planet, in metres, for degrees.")
@click.option("--open", "opens", is_flag=True, help="Open the page in a browser.")
@click.option("--stdin", "listens", is_flag=True,
              help="For programs: read names of further files from stdin, a line each, answer each"
              " with a line of JSON, and end where stdin ends.")  # fmt: skip
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
def serve(
    files: tuple[str, ...],
    host: str,
    port: int,
    hosts: tuple[str, ...],
    cors: bool,
    n_decoding: int,
    radius: float | None,
    opens: bool,
    listens: bool,
    quiet: bool,
) -> None:
    """Serve FILES (.twz): a page that flies over them, terrain-RGB and quantized-mesh tiles.

    Open the printed address in a browser. MapLibre reads NAME/tiles.json, CesiumJS NAME/mesh,
    NAME/height?lon=…&lat=… answers a height; NAME is the file's name without its ending.
    """
    if not files and not listens:
        raise click.UsageError("Missing argument 'FILES...'.")
    uvicorn = need("uvicorn", extra="serve", purpose="serve")
    for package in ("fastapi", "PIL"):
        need(package, extra="serve", purpose="serve")
    from terrainwave.ext.serve.app import make_app

    announce_compiling(quiet=quiet)
    named = tuple(name for name in (host, *hosts) if name not in ("0.0.0.0", "::"))
    app = make_app(list(files), hosts=named, cors=cors, n_decoding=n_decoding, radius=radius)
    n_terrains = len(app.state.layers)
    listener = _listen(host, port)
    address = f"http://{_in_url(host)}:{listener.getsockname()[1]}/"
    if not quiet:
        click.echo(f"{count_of(n_terrains, 'terrain')} at {address}  (Ctrl-C ends)")
    if host in ("0.0.0.0", "::") and not hosts:
        print_note("asked by other names than localhost it refuses: name them with --allow-host")
    if opens:
        webbrowser.open(address)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=2))
    if listens:
        add = app.state.shelf.add
        threading.Thread(target=_serve_named, args=(add, address, server), daemon=True).start()
    with listener:
        try:
            server.run(sockets=[listener])
        except Terminated:
            raise
        except KeyboardInterrupt:  # the way to end it, not a failure
            if not quiet:
                click.echo("\ngoodbye")


def _serve_named(add: Callable[[str], Any], address: str, server: Any) -> None:
    """Serve each file that a line of stdin names, and answer it; end the server where stdin ends.

    An answer has `file`, as it was named, and `url` and `info` or `error`.
    """
    # Without a buffer: the process may end while this thread waits for a line.
    with open(0, "rb", buffering=0, closefd=False) as names:
        try:
            for line in names:
                file = line.decode("utf-8", "replace").rstrip("\r\n")
                click.echo(json.dumps({"file": file} | _answer(add, file, address)))
        finally:
            server.should_exit = True


def _answer(add: Callable[[str], Any], file: str, address: str) -> dict[str, Any]:
    try:
        raster = add(file)
    except TerrainwaveError as error:
        return {"error": message_of(error)}
    url = f"{address}{raster.name}.tif"
    return {"url": url, "info": plain_json(raster.info.to_dict())}


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket bound to the address.

    Raises
    ------
    StorageError
        If the address cannot be had.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        # By this number asyncio knows connections that it must switch Nagle's algorithm off for: a
        # client would wait 40 ms for a short answer's body.
        listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()  # whoever reads the address may ask at once
    except OSError as error:
        raise StorageError(
            f"cannot listen on {host}, port {port}: {error.strerror or error}; choose another"
            " with --port, or --port 0 for a free one"
        ) from error
    return listener


def _in_url(host: str) -> str:
    shown = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"[{shown}]" if ":" in shown else shown
