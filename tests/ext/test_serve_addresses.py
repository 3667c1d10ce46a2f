"""Do addresses of `terrainwave serve` lead to what they name, after restarts and behind proxies?"""

import pytest
from commands import one_line, run
from ext.rasters import BOUNDS, hills, write_twz
from fastapi.testclient import TestClient

from terrainwave.errors import InvalidArgumentError
from terrainwave.ext.serve import layers
from terrainwave.ext.serve.app import make_app

TILE = "9/267/181.png"
LOOPBACK, ELSEWHERE = ("127.0.0.1", 40000), ("10.1.2.3", 40000)


def client_of(*paths, host="http://127.0.0.1", client=LOOPBACK, **options):
    app = make_app([str(path) for path in paths], **options)
    return TestClient(app, host, client=client, raise_server_exceptions=False)


class BrowserCache:
    """Keeps replies as RFC 9111 lets a browser keep them, for some seconds at least."""

    def __init__(self):
        self._kept = {}

    def get(self, client, address):
        """Return the body of a reply, kept or new."""
        kept = self._kept.get(address)
        if kept is not None and "max-age" in kept.headers["cache-control"]:
            return kept.content
        tag = None if kept is None else kept.headers.get("etag")
        reply = client.get(address, headers={"If-None-Match": tag} if tag else {})
        if reply.status_code == 304:
            return kept.content
        assert reply.status_code == 200, address
        assert set(reply.headers["cache-control"].split(", ")) & {"no-cache", "max-age=31536000"}
        self._kept[address] = reply
        return reply.content


def written_by_users(client):
    """Return addresses without a version, of all that is served."""
    layer = client.get("/hills/mesh/layer.json").json()
    first = layer["available"][-1][0]
    mesh = f"{layer['maxzoom']}/{first['startX']}/{first['startY']}.terrain"
    return [
        f"/hills/rgb/{TILE}", f"/hills/rgb/{TILE}?encoding=mapbox&voids=height&rim=4",
        f"/hills/voids/{TILE}?color=ffffff&rim=8", f"/hills/mesh/{mesh}", "/hills.tif",
        "/hills.twz", "/hills/tiles.json", "/hills/mesh/layer.json", "/terrains.json",
        "/hills/height?lon=8.2&lat=46.2", "/", "/static/page.css",
    ]  # fmt: skip


def told_by_the_server(client):
    """Return addresses of tiles as programs and the page find them."""
    z, x, y = TILE.removesuffix(".png").split("/")
    queries = ("", "?rim=4", "?encoding=terrarium", "?voids=transparent")
    found = [
        client.get(f"/hills/tiles.json{query}").json()["tiles"][0].format(z=z, x=x, y=y)
        for query in queries
    ]
    (terrain,) = client.get("/terrains.json").json()
    asked = f"v={terrain['tag']}&rim=4"  # as served.js and page.js put them together
    look = f"encoding={terrain['encoding']}&voids=height"
    found += [f"/hills/rgb/{TILE}?{asked}&{look}", f"/hills/voids/{TILE}?{asked}&color=ffffff"]
    layer = client.get("/hills/mesh/layer.json").json()
    first = layer["available"][-1][0]
    template = layer["tiles"][0].replace("{version}", layer["version"])
    mesh = template.format(z=layer["maxzoom"], x=first["startX"], y=first["startY"])
    return [*found, f"/hills/mesh/{mesh}"]


CHANGES = {
    "another encoding": {"encoding": "terrarium"},
    "transparent voids": {"transparent_voids": True},
    "another radius": {"radius": 1_737_400.0},
    "another file": {},
    "another release": {},
    "nothing": {},
}


@pytest.mark.few(1)
@pytest.mark.parametrize("change", CHANGES)
def test_a_browser_shows_nothing_old_after_a_restart(tmp_path, monkeypatch, change):
    path = write_twz(tmp_path, hills(65, 97), BOUNDS, max_error=2)
    cache = BrowserCache()
    with client_of(path) as client:
        written, before = written_by_users(client), told_by_the_server(client)
        for address in [*written, *before]:
            cache.get(client, address)
    if change == "another file":
        path.unlink()
        write_twz(tmp_path, hills(65, 97)[::-1].copy(), BOUNDS, max_error=2)
    if change == "another release":
        monkeypatch.setattr(layers, "__version__", "99.0")
    with client_of(path, **CHANGES[change]) as client:
        after = told_by_the_server(client)
        for address in [*written, *after]:
            assert cache.get(client, address) == client.get(address).content, address
    # Of another look, only addresses that name it differ.
    is_other_file = change not in ("nothing", "another encoding", "transparent voids")
    assert bool(set(before) & set(after)) == (not is_other_file)
    assert (before == after) == (change == "nothing")


def test_only_addresses_that_name_all_that_a_tile_depends_on_are_kept(hilly):
    with client_of(hilly) as client:
        (terrain,) = client.get("/terrains.json").json()
        version = f"v={terrain['tag']}"
        cases = {
            f"/hills/rgb/{TILE}?{version}&encoding=mapbox&voids=height": True,
            f"/hills/rgb/{TILE}?{version}&encoding=mapbox": False,
            f"/hills/rgb/{TILE}?{version}&voids=height": False,
            f"/hills/rgb/{TILE}?v=0&encoding=mapbox&voids=height": False,
            f"/hills/rgb/{TILE}": False,
            f"/hills/voids/{TILE}?{version}&color=ffffff&rim=4": True,
            f"/hills/voids/{TILE}?color=ffffff&rim=4": False,
            f"/hills.tif?{version}": False,
            "/hills/rgb/9/0/0.png": False,
        }
        for address, is_kept in cases.items():
            said = client.get(address).headers["cache-control"]
            assert said == ("max-age=31536000, immutable" if is_kept else "no-cache"), address


def tiles_of(client, **headers):
    """Return the address of tiles that tiles.json tells, without its query."""
    named = {f"X-Forwarded-{name}": value for name, value in headers.items()}
    reply = client.get("/hills/tiles.json", headers=named)
    assert reply.status_code == 200, reply.text
    return reply.json()["tiles"][0].split("?")[0]


TILES = "/hills/rgb/{z}/{x}/{y}.png"


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("headers", "begins"),
    [
        ({}, "http://127.0.0.1"),
        ({"Prefix": "/terrain"}, "http://127.0.0.1/terrain"),
        ({"Prefix": "/terrain/"}, "http://127.0.0.1/terrain"),
        ({"Prefix": "/"}, "http://127.0.0.1"),
        ({"Prefix": "/a/b.c-d"}, "http://127.0.0.1/a/b.c-d"),
        ({"Prefix": "/hills"}, "http://127.0.0.1/hills"),
        ({"Prefix": "/hills/rgb"}, "http://127.0.0.1/hills/rgb"),
        ({"Proto": "https"}, "https://127.0.0.1"),
        ({"Host": "example.org"}, "http://example.org"),
        ({"Host": "example.org:8443"}, "http://example.org:8443"),
        (
            {"Host": "example.org", "Proto": "https", "Prefix": "/terrain"},
            "https://example.org/terrain",
        ),
        ({"Host": "evil.example, example.org", "Prefix": "/x, /y"}, "http://example.org/y"),
        ({"Host": "", "Prefix": ""}, "http://127.0.0.1"),
    ],
)
def test_tile_addresses_are_those_that_a_proxy_on_this_machine_forwards(hilly, headers, begins):
    with client_of(hilly, hosts=("example.org",)) as client:
        assert tiles_of(client, **headers) == begins + TILES
        forwarded = {f"X-Forwarded-{name}": value for name, value in headers.items()}
        # The proxy has cut the prefix off, and asks for the rest.
        for path in (f"/hills/rgb/{TILE}", "/", "/static/page.css", "/terrains.json", "/hills.tif"):
            assert client.get(path, headers=forwarded).status_code == 200, path
            assert client.head(path, headers=forwarded).status_code == 200, path


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("Prefix", "terrain"), ("Prefix", "/a b"), ("Prefix", "/.."), ("Prefix", "/a/../b"),
        ("Prefix", "//evil.example"), ("Prefix", "/a%2F.."), ("Prefix", "/a?b"), ("Prefix", "/<b>"),
        ("Prefix", "/é"), ("Host", "evil.example/a"), ("Host", "a@localhost"), ("Host", "::1"),
        ("Host", "localhost:port"), ("Proto", "javascript"), ("Proto", "HTTPS:"),
    ],
)  # fmt: skip
def test_what_is_no_part_of_an_address_is_refused_in_one_line(hilly, name, value):
    with client_of(hilly, hosts=("*",)) as client:
        headers = {f"X-Forwarded-{name}": value.encode("utf-8")}
        reply = client.get("/hills/tiles.json", headers=headers)
    assert reply.status_code == 400
    detail = reply.json()["detail"]
    assert detail.startswith(f"found X-Forwarded-{name} ")
    assert ", expected " in detail


@pytest.mark.parametrize(
    ("url", "begins"),
    [
        ("https://example.org/terrain/", "https://example.org/terrain"),
        ("https://example.org/terrain", "https://example.org/terrain"),
        ("http://example.org:8080", "http://example.org:8080"),
        ("https://[2001:db8::1]/a/b", "https://[2001:db8::1]/a/b"),
    ],
)
def test_tile_addresses_begin_with_the_public_url(hilly, url, begins):
    with client_of(hilly, public_url=url) as client:
        assert tiles_of(client) == begins + TILES
        assert tiles_of(client, Prefix="/other", Proto="http") == begins + TILES


def test_requests_by_the_host_of_the_public_url_are_accepted(hilly):
    options = {"host": "https://example.org", "public_url": "https://example.org:8443/terrain/"}
    with client_of(hilly, **options) as client:
        assert client.get("/terrains.json").status_code == 200
    with client_of(hilly, **options | {"host": "https://sub.example.org"}) as client:
        assert client.get("/terrains.json").status_code == 400


@pytest.mark.parametrize(
    "url",
    [
        "example.org/terrain", "ftp://example.org", "https://", "https://example.org/a?b=c",
        "https://example.org/#a", "https://user@example.org", "https://example.org/a/../b",
        "https://example.org/a b", "", "//example.org", "https://example.org:port/",
        "https://[2001:db8::1/", "https://[example.org]/",
    ],
)  # fmt: skip
def test_a_public_url_that_is_none_is_refused(hilly, url):
    with pytest.raises(InvalidArgumentError, match=r"found public_url .*, expected http or https"):
        make_app([str(hilly)], public_url=url)


def test_options_for_proxies_that_are_wrong_are_one_line_of_the_command(hilly):
    told = one_line(run("serve", hilly, "--public-url", "example.org"), 2)
    assert "--public-url" in told
    assert "expected http or https" in told
    told = one_line(run("serve", hilly, "--proxy", "10.0.0.300"), 2)
    assert "--proxy" in told
    assert "an IP address such as 10.0.0.7" in told
