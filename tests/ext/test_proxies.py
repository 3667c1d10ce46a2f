"""Does `terrainwave serve` work behind nginx and Caddy with the settings of docs/how-to/web.md?"""

import contextlib
import re
import subprocess
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from ext.browser import served
from ext.jupyter import free_port

import terrainwave
from terrainwave.ext.serve.app import make_app

pytestmark = pytest.mark.full
ROOT = Path(__file__).parents[2]


def settings_of(language):
    """Return the one block of a language on the page on web pages."""
    text = (ROOT / "docs" / "how-to" / "web.md").read_text(encoding="utf-8")
    (block,) = re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)
    return block


def program(name, place):
    """Return a server that is installed, or that tools/install_system.sh unpacked."""
    for root in (Path("/"), ROOT / "build" / name):
        if (root / place).exists():
            return root / place
    pytest.skip(f"{name} is missing: run make system-{name}")


@contextlib.contextmanager
def nginx(folder, settings):
    """Yield the address of nginx with these settings in its `server` block."""
    command, port = [program("nginx", "usr/sbin/nginx")], free_port()
    places = "".join(
        f"{kind}_temp_path {folder / kind};"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (folder / "nginx.conf").write_text(
        f"user root; pid {folder}/pid; error_log {folder}/errors; events {{}} http {{ {places}"
        f" access_log off; server {{ listen 127.0.0.1:{port}; {settings} }} }}"
    )
    command += ["-c", folder / "nginx.conf", "-p", folder, "-e", folder / "errors"]
    subprocess.run(command, check=True)  # it listens once this returns
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        subprocess.run([*command, "-s", "stop"], check=True)


@contextlib.contextmanager
def caddy(folder, settings):
    """Yield the address of Caddy with these settings of a site."""
    command, port = program("caddy", "usr/bin/caddy"), free_port()
    address = f"http://127.0.0.1:{port}"
    site = settings.replace("example.org {", f"{address} {{")
    assert site != settings
    (folder / "Caddyfile").write_text(f"{{\n\tadmin off\n}}\n{site}")
    with subprocess.Popen(
        [command, "run", "--config", folder / "Caddyfile", "--adapter", "caddyfile"],
        stderr=subprocess.PIPE, text=True, env={"HOME": str(folder)},
    ) as server:  # fmt: skip
        try:
            told = []
            for line in server.stderr:
                told.append(line)
                if "serving initial configuration" in line:
                    break
            else:
                pytest.fail("".join(told))
            yield address
        finally:
            server.terminate()


def get(address, **headers):
    request = urllib.request.Request(address, headers=headers)
    with urllib.request.urlopen(request, timeout=60) as reply:
        return reply.read(), reply


PROXIES = {"nginx": nginx, "caddy": caddy}
FORWARDING = re.compile(r".*X-Forwarded-.*\n")


@pytest.mark.parametrize("name", PROXIES)
@pytest.mark.parametrize("way", ["headers", "public url"])
def test_all_addresses_below_a_path_work(hilly, tmp_path, name, way):
    """Those of the page that are relative, and those that tiles.json tells."""
    settings = settings_of(name)
    assert len(FORWARDING.findall(settings)) == (3 if name == "nginx" else 1)
    if way == "public url":
        settings = FORWARDING.sub("", settings)
    with contextlib.ExitStack() as stack:
        behind = free_port()
        proxy = stack.enter_context(PROXIES[name](tmp_path, settings.replace("8765", f"{behind}")))
        public = f"{proxy}/terrain/" if way == "public url" else None
        app = make_app([str(hilly)], public_url=public)
        direct = stack.enter_context(served(app, behind))
        page, reply = get(f"{proxy}/terrain")
        assert reply.url == f"{proxy}/terrain/"
        for relative in re.findall(r'(?:src|href)="([^":]+)"', page.decode()):
            assert get(f"{reply.url}{relative}")[0] == get(f"{direct}/{relative}")[0]
        for path in ("terrains.json", "hills/height?lon=8.2&lat=46.2", "hills/mesh/layer.json"):
            assert get(f"{proxy}/terrain/{path}")[0] == get(f"{direct}/{path}")[0]
        (tiles,) = re.findall(
            r'"tiles":\["([^"]+)"', get(f"{proxy}/terrain/hills/tiles.json")[0].decode()
        )
        assert tiles.startswith(f"{proxy}/terrain/hills/rgb/")
        tile, reply = get(tiles.format(z=9, x=267, y=181))
        assert tile == get(f"{direct}/hills/rgb/9/267/181.png")[0]
        assert "immutable" in reply.headers["cache-control"]
        with terrainwave.open(hilly) as terrain:
            with terrainwave.open(f"{proxy}/terrain/hills.twz") as remote:
                np.testing.assert_array_equal(remote.read(), terrain.read())


def test_a_client_of_the_proxy_changes_no_address(hilly, tmp_path):
    forged = {"X-Forwarded-Prefix": "/x", "X-Forwarded-Host": "localhost:1"}
    forged |= {"X-Forwarded-Proto": "https"}
    with contextlib.ExitStack() as stack:
        behind = free_port()
        settings = settings_of("nginx").replace("8765", f"{behind}")
        proxy = stack.enter_context(nginx(tmp_path, settings))
        stack.enter_context(served(make_app([str(hilly)]), behind))
        told = get(f"{proxy}/terrain/hills/tiles.json", **forged)[0].decode()
    assert f'"{proxy}/terrain/hills/rgb/' in told
