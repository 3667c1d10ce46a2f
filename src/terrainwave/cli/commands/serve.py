"""Command serve: terrain over HTTP."""

import json
import re
import signal
import socket
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import click

from terrainwave import interrupts
from terrainwave.arguments import AS_IS, VERTICAL, VERTICAL_HELP, count_of
from terrainwave.cli.options import (
    PAGE_SEA_LEVEL_OPTION,
    RADIUS_OPTION,
    NamedInput,
)
from terrainwave.cli.output import (
    CommandWithoutTarget,
    announce_compiling,
    message_of,
    plain_json,
    print_note,
)
from terrainwave.cli.signals import Terminated
from terrainwave.errors import StorageError, TerrainwaveError
from terrainwave.extras import need, with_extra
from terrainwave.names import TILE_ENCODINGS

# A name, an address, all names below one, or any; without a port.
_ANY_HOST = ("0.0.0.0", "::")
_HOST_NAME = re.compile(r"(\*\.)?[\w.-]+|\[[0-9A-Fa-f:.]+\]|\*")


def _host_names(_: Any, __: Any, names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
        if not _HOST_NAME.fullmatch(name):
            raise click.BadParameter(
                f"found {name!r}, expected a host name without a port, *.name for all below one,"
                " or * for any"
            )
    return names


@click.command(cls=CommandWithoutTarget)
@click.argument("files", nargs=-1, type=NamedInput())
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), default=8765, show_default=True,
              help="Port to listen on; 0 selects a free one.")  # fmt: skip
@click.option("--allow-host", "hosts", multiple=True, metavar="NAME", callback=_host_names,
              help="Accept requests by this host name, too, not only localhost.")  # fmt: skip
@click.option(
    "--public-url",
    metavar="URL",
    help="Address of this server as browsers see it, if it is behind a proxy, such as"
    " https://example.org/terrain/. Addresses of tiles begin with it, and requests by its host are"
    " accepted.",
)
@click.option(
    "--proxy",
    "proxy",
    multiple=True,
    metavar="ADDRESS",
    help="Trust X-Forwarded-Proto, -Host and -Prefix of a proxy at this IP address or network,"
    " too, not only of one on this machine.",
)
@click.option("--cors", is_flag=True, help="Let pages of other sites read the tiles.")
@click.option("--threads", "n_decoding", type=click.IntRange(1, 64), default=2, show_default=True,
              help="Requests that decode at the same time.")  # fmt: skip
@RADIUS_OPTION
@click.option("--vertical", type=click.Choice(VERTICAL), default=AS_IS, show_default=True,
              help=f"Heights of NAME/mesh{VERTICAL_HELP}")  # fmt: skip
@click.option(
    "--encoding",
    type=click.Choice(TILE_ENCODINGS),
    default=TILE_ENCODINGS[0],
    show_default=True,
    help="Encoding of terrain-RGB tiles whose address has no ?encoding=. mapbox has steps of 0.1 m"
    " above -10000 m, terrarium steps of 1/256 m above -32768 m.",
)
@click.option(
    "--transparent-voids",
    is_flag=True,
    help="Make voids of terrain-RGB tiles transparent, unless their address has ?voids=height.",
)
@PAGE_SEA_LEVEL_OPTION
@click.option("--open", "opens", is_flag=True, help="Open the page in a browser.")
@click.option("--stdin", "listens", is_flag=True,
              help="For programs: read names of further files from stdin, one a line, answer each"
              " with one line of JSON, and stop at the end of stdin.")  # fmt: skip
@click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes.")
@with_extra("serve")
def serve(
    files: tuple[str, ...],
    host: str,
    port: int,
    hosts: tuple[str, ...],
    opens: bool,
    listens: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Serve FILES (.twz): a page that flies over them, terrain-RGB and quantized-mesh tiles.

    Open the printed address in a browser. MapLibre reads NAME/tiles.json, and CesiumJS NAME/mesh.
    NAME/height?lon=…&lat=… returns a height. NAME is the file's name without its ending.
    """
    if not files and not listens:
        raise click.UsageError("Missing argument 'FILES...'.")
    for package in ("uvicorn", "fastapi", "PIL"):
        need(package, extra="serve", purpose="serve")
    from terrainwave.ext.serve.app import make_app
    from terrainwave.ext.serve.client_limits import server_of

    with _saying_that_it_stopped(quiet=quiet):
        announce_compiling(quiet=quiet)
        named = tuple(name for name in (host, *hosts) if name not in _ANY_HOST)
        app = make_app(list(files), hosts=named, **options)
        with _listen(host, port) as listener:
            shown = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
            shown = f"[{shown}]" if ":" in shown else shown
            address = f"http://{shown}:{listener.getsockname()[1]}/"
            if not quiet:
                n_terrains = count_of(len(app.state.layers), "terrain")
                click.echo(f"{n_terrains} at {address}  (Ctrl-C ends)")
            if host in _ANY_HOST and not hosts and options["public_url"] is None:
                print_note(
                    "the server refuses requests by other names than localhost; allow a name with"
                    " --allow-host"
                )
            if opens:
                webbrowser.open(address)
            server = server_of(app, n_files=len(files))
            if listens:  # also serve files named on stdin
                arguments = app.state.shelf.add, address, server
                threading.Thread(target=_serve_named, args=arguments, daemon=True).start()
            server.run(sockets=[listener])
            interrupts.check()


@contextmanager
def _saying_that_it_stopped(*, quiet: bool) -> Iterator[None]:
    """End the command by a signal without an error: status 0 after Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt as ended:
        interrupts.reset()
        if not quiet:
            click.echo("\nstopped")
        if isinstance(ended, Terminated) and ended.number != signal.SIGINT:
            click.get_current_context().exit(ended.status)


def _serve_named(add: Callable[[str], Any], address: str, server: Any) -> None:
    """Serve each file named by a line of stdin; answer `file`, and `url` and `info` or `error`."""
    # Unbuffered: the process may end while this thread waits for a line.
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
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise StorageError(
            f"cannot listen on {host}: {error.strerror or error}; expected an address of this"
            " machine, such as 127.0.0.1, or 0.0.0.0 for all of them"
        ) from error
    try:
        # asyncio switches Nagle's algorithm off only for sockets with this protocol number;
        # otherwise a client waits 40 ms for the body of a short answer.
        listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()  # clients may connect as soon as the address is printed
    except OSError as error:
        raise StorageError(
            f"cannot listen on {host}, port {port}: {error.strerror or error}; choose another"
            " with --port, or --port 0 for a free one"
        ) from error
    return listener
