"""Does a published folder work on common web hosts, and say what a host does wrong?"""

import contextlib
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from ext.browser import console, wait_until
from ext.rasters import BOUNDS, hills, write_twz
from ext.static_server import static_server

import terrainwave
from terrainwave.ext.publish import publish_site

ROOT = Path(__file__).parents[2]
# Where tools/install_system.sh unpacks Debian's nginx, which would listen if it were installed.
NGINX = ROOT / "build" / "nginx"
LICENCES = {"terrainwave/LICENSE", "static/maplibre/LICENSE.txt"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    twz = write_twz(folder, hills(129, 161) * 4, BOUNDS, max_error=8)
    publish_site([str(twz)], folder / "site")
    return folder / "site"


def test_published_files_have_endings_that_every_host_knows(site):
    names = {path.relative_to(site).as_posix() for path in site.rglob("*") if path.is_file()}
    assert LICENCES < names
    endings = {Path(name).suffix for name in names - LICENCES}
    assert endings <= {".html", ".js", ".css", ".json", ".png", ".jpg", ".twz"}


# Hosts


@contextlib.contextmanager
def nginx(folder):
    """Yield the address of nginx with Debian's table of endings, and what its settings say."""
    root = next((root for root in (Path("/"), NGINX) if (root / "usr/sbin/nginx").exists()), None)
    if root is None:
        pytest.skip("nginx is missing: run make system-nginx")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    work = folder.parent / "nginx"
    work.mkdir()
    places = "".join(
        f"{kind}_temp_path {work / kind};"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (work / "nginx.conf").write_text(f"""
        user root; pid {work}/pid; error_log {work}/errors;
        events {{}}
        http {{
            include {root}/etc/nginx/mime.types; default_type application/octet-stream;
            access_log off; {places}
            server {{ listen 127.0.0.1:{port}; root {folder}; }}
        }}
    """)
    command = [
        root / "usr/sbin/nginx",
        "-c",
        work / "nginx.conf",
        "-p",
        work,
        "-e",
        work / "errors",
    ]
    subprocess.run(command, check=True)  # it listens once this returns
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        subprocess.run([*command, "-s", "stop"], check=True)


@contextlib.contextmanager
def http_server(folder):
    """Yield the address of `python -m http.server`."""
    command = [sys.executable, "-u", "-m", "http.server", "0", "-b", "127.0.0.1", "-d", folder]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        try:
            yield re.search(r"http://127\.0\.0\.1:\d+", server.stdout.readline())[0]
        finally:
            server.terminate()


@contextlib.contextmanager
def simple_host(folder):
    """Yield the address of a host that sends what it does not know as application/octet-stream."""
    with static_server(folder) as server:
        yield server.address


def show(driver, address, state):
    driver.get("about:blank")
    console(driver)
    driver.get(address)
    wait_until(driver, f"document.body?.dataset.state === '{state}'")


@pytest.mark.full
@pytest.mark.gl
@pytest.mark.large
@pytest.mark.parametrize("host", [nginx, http_server, simple_host])
def test_the_page_draws_the_terrain(site, browser, tmp_path, host):
    shutil.copytree(site, tmp_path / "site")
    with host(tmp_path / "site") as address:
        show(browser, address, "complete")
        with terrainwave.open(site / "hills.twz") as terrain:
            height = terrain.sample([(8.25, 46.2)])[0]
        asked = f"Math.abs(terrainMap.queryTerrainElevation([8.25, 46.2]) - {height}) < 80"
        wait_until(browser, asked)
        assert not console(browser)


# What a host does wrong


def told(browser):
    return browser.find_element("id", "message").text


@pytest.mark.full
def test_a_module_that_was_cut_is_named(site, browser, tmp_path):
    shutil.copytree(site, tmp_path / "site")
    module = tmp_path / "site" / "static" / "colours.js"
    module.write_bytes(module.read_bytes()[:1000])
    with static_server(tmp_path / "site") as server:
        show(browser, server.address, "failed")
        assert f"This page cannot start: {server.address}/static/colours.js" in told(browser)
