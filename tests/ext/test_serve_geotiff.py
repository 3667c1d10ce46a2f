"""`/NAME.tif` of `terrainwave serve`: what GDAL and browsers get of it."""

import asyncio
import threading
from unittest.mock import Mock

import numpy as np
import pytest
import rasterio
from ext.browser import served
from ext.rasters import BOUNDS
from fastapi import HTTPException
from fastapi.testclient import TestClient
from rasterio.windows import Window

import terrainwave
from terrainwave.errors import CorruptStreamError
from terrainwave.ext.serve import sending
from terrainwave.ext.serve.app import make_app
from terrainwave.ext.serve.sending import PART, Ahead, Desk, Span, asked_span, begun, is_same, parts

TAG = '"abc"'


@pytest.fixture(scope="module")
def client(hilly):
    with TestClient(make_app([str(hilly)]), "http://127.0.0.1") as client:
        yield client


@pytest.mark.full
def test_gdal_reads_true_heights_over_http(hilly):
    options = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "CPL_VSIL_CURL_USE_HEAD": "YES"}
    with (
        served(make_app([str(hilly)])) as address,
        rasterio.Env(**options),
        terrainwave.open(hilly) as terrain,
    ):
        with rasterio.open(f"/vsicurl/{address}/hills.tif") as dataset:
            assert dataset.crs.to_epsg() == 4326
            assert dataset.bounds == pytest.approx(BOUNDS)
            np.testing.assert_array_equal(dataset.read(1), terrain.read())
            window = Window(50, 20, 40, 30)
            np.testing.assert_array_equal(
                dataset.read(1, window=window), terrain.read((20, 50, 30, 40))
            )


def test_a_range_is_that_part(client):
    whole = client.get("/hills.tif")
    assert whole.status_code == 200
    assert len(whole.content) == int(whole.headers["content-length"])
    part = client.get("/hills.tif", headers={"Range": "bytes=100000-2400000"})
    assert part.status_code == 206
    last = min(2_400_000, len(whole.content) - 1)
    assert part.headers["content-range"] == f"bytes 100000-{last}/{len(whole.content)}"
    assert part.content == whole.content[100_000:2_400_001]


def test_what_a_client_has_is_not_sent_again(client):
    tag = client.head("/hills.tif").headers["etag"]
    assert client.get("/hills.tif", headers={"If-None-Match": tag}).status_code == 304


def test_a_range_behind_the_end_is_refused_with_the_size(client):
    size = client.head("/hills.tif").headers["content-length"]
    answer = client.get("/hills.tif", headers={"Range": f"bytes={size}-"})
    assert answer.status_code == 416
    assert answer.headers["content-range"] == f"bytes */{size}"


@pytest.mark.parametrize(
    ("asked", "is_same_version"),
    [
        ("", False),
        (TAG, True),
        (f"W/{TAG}", True),
        (f'"x",{TAG}', True),
        ("*", True),
        ('"x"', False),
    ],
)
def test_a_version_is_known_by_any_of_the_names_a_client_has(asked, is_same_version):
    assert is_same(asked, TAG) is is_same_version


def test_a_file_that_cannot_be_read_is_told_before_the_answer_begins(client, monkeypatch):
    monkeypatch.setattr(
        client.app.state.layers["hills"].geotiff,
        "read_at",
        Mock(side_effect=CorruptStreamError("no")),
    )
    assert client.get("/hills.tif").status_code == 500


def test_an_answer_that_has_begun_waits_where_others_are_refused(monkeypatch):
    monkeypatch.setattr(sending, "N_WAITING", 0)

    async def get_all():
        desk = Desk(1)
        span = Span(0, 3 * PART, 3 * PART, is_part=False)
        made = await begun(parts(desk, lambda place, n_bytes: bytes(n_bytes), span, None))
        release = threading.Event()
        other = asyncio.create_task(desk.do(release.wait, 20, is_begun=True))
        await asyncio.sleep(0)
        with pytest.raises(HTTPException, match="503"):
            await desk.do(int)
        release.set()
        assert sum([len(part) async for part in made]) == 3 * PART
        await other

    asyncio.run(get_all())


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ({}, (0, 1000, False)),
        ({"range": "bytes=0-99"}, (0, 100, True)),
        ({"range": "bytes=900-"}, (900, 1000, True)),
        ({"range": "bytes=900-5000"}, (900, 1000, True)),
        ({"range": "bytes=-10"}, (990, 1000, True)),
        ({"range": "bytes=-5000"}, (0, 1000, True)),
        ({"range": "bytes=-0"}, None),
        ({"range": "bytes=1000-"}, None),
        # Not understood, so all (RFC 9110, 14.2).
        ({"range": "bytes=-"}, (0, 1000, False)),
        ({"range": "bytes=9-3"}, (0, 1000, False)),
        ({"range": "bytes=0-3,6-9"}, (0, 1000, False)),
        ({"range": "samples=0-3"}, (0, 1000, False)),
        ({"range": f"bytes=0-{'9' * 5000}"}, (0, 1000, False)),
        ({"range": f"bytes={'9' * 5000}-"}, (0, 1000, False)),
        ({"range": f"bytes=-{'9' * 5000}"}, (0, 1000, False)),
        ({"range": f"bytes=5-{'9' * 18}"}, (5, 1000, True)),
        ({"range": "bytes=+1-2"}, (0, 1000, False)),
        ({"range": "bytes=\u0661-\u0662"}, (0, 1000, False)),
        ({"range": "bytes=0-3", "if-range": TAG}, (0, 4, True)),
        ({"range": "bytes=0-3", "if-range": '"old"'}, (0, 1000, False)),
    ],
)
def test_ranges_are_read_as_the_standard_says(headers, expected):
    span = asked_span(headers, 1000, TAG)
    assert span == (expected and Span(*expected[:2], 1000, expected[2]))


def places_read(spans):
    """Return the places that are read, a part each, while one client gets spans of 20 parts."""
    places = []

    def read(place, n_bytes):
        places.append(place // PART)
        return bytes(n_bytes)

    async def get_all():
        desk, ahead = Desk(1), Ahead(read)
        for start, stop in spans:
            span = Span(start * PART, stop * PART, 20 * PART, is_part=True)
            sent = [part async for part in parts(desk, read, span, ahead)]
            assert sum(map(len, sent)) == span.stop - span.start
            while not desk.is_free or (ahead._task and not ahead._task.done()):
                await asyncio.sleep(0.001)

    asyncio.run(get_all())
    return places


def test_what_a_client_that_reads_on_will_ask_for_is_made_before():
    assert places_read([(4, 6), (9, 11)]) == [4, 5, 9, 10]
    assert places_read([(4, 6), (6, 8)]) == [4, 5, 6, 7, 8, 9, 10, 11]
    assert places_read([(12, 18)]) == [12, 13, 14, 15, 16, 17, 18, 19]
