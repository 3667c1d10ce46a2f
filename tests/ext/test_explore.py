"""The kernel's half of the map in notebooks: questions, limits, windows, cameras."""

import re
import threading

import numpy as np
import pytest
from ext.rasters import BOUNDS, hills, write_twz
from ext.static_server import static_server
from rasterio.warp import transform
from strategies import terrain_like

import terrainwave
from terrainwave.ext.notebook import channel as protocol
from terrainwave.ext.notebook.channel import MOST_BYTES, MOST_RANGES, MOST_WAITING, Answer, Channel
from terrainwave.ext.notebook.drawn import region_of_box
from terrainwave.globe.lonlat import Globe

PATIENCE = 30


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    return write_twz(tmp_path_factory.mktemp("hills"), hills(60, 81), BOUNDS, max_error=2)


@pytest.fixture
def terrain(twz):
    with terrainwave.open(twz) as opened:
        yield opened


class Page:
    """The page's end of a channel: what it was sent, by the ids of its questions."""

    def __init__(self):
        self.sent, self.changed = [], threading.Condition()

    def send(self, content, buffers=None):
        with self.changed:
            self.sent.append((content, list(buffers or [])))
            self.changed.notify_all()

    def ask(self, take, what, asked="1", **question):
        """Return the answer to one question, once it is there."""
        take({"id": asked, "what": what, **question})
        return self.answer(asked)

    def answer(self, asked):
        with self.changed:
            assert self.changed.wait_for(lambda: self._found(asked), PATIENCE)
            return self._found(asked)[-1]

    def _found(self, asked):
        return [one for one in self.sent if one[0]["id"] == asked and "taken" not in one[0]]


@pytest.fixture
def page():
    return Page()


@pytest.fixture
def gate():
    """Return what threads wait for, and no longer than the test."""
    event = threading.Event()
    yield event
    event.set()


class Source:
    """Bytes, of which it is noted what was read."""

    def __init__(self, data):
        self.data, self.size, self.asked = data, len(data), []

    def read_many(self, spans):
        self.asked += spans
        return [self.data[span.offset : span.end] for span in spans]


def channel_of(source, page):
    answering = {"ranges": lambda question: protocol.read_ranges(source, question)}
    return Channel(page.send, answering, {})


def explored(terrain, page):
    """Return the map of a terrain whose messages come to `page`."""
    widget = terrain.explore()
    widget._channel._send = page.send
    return widget


def test_ranges_come_as_buffers_in_the_order_asked(page):
    source = Source(bytes(range(256)))
    ranges = [[200, 256], [0, 1], [7, 9]]
    content, buffers = page.ask(channel_of(source, page).take, "ranges", ranges=ranges)
    assert content == {"id": "1"}
    assert buffers == [source.data[start:end] for start, end in ranges]


def test_a_slow_source_does_not_hold_up_the_kernel(page, gate):
    class Slow(Source):
        def read_many(self, spans):
            assert gate.wait(PATIENCE)
            return super().read_many(spans)

    channel = channel_of(Slow(b"abc"), page)
    channel.take({"id": "1", "what": "ranges", "ranges": [[0, 1]]})
    assert page.sent == [({"id": "1", "taken": True}, [])]
    gate.set()
    assert page.answer("1")[1] == [b"a"]


@pytest.mark.parametrize("what", [None, 3, "", "rm", ["ranges"], {"ranges": 1}, "__class__"])
def test_a_question_of_an_unknown_kind_is_refused_by_name(page, what):
    content, _ = page.ask(channel_of(Source(b"abc"), page).take, what)
    assert "expected ranges" in content["error"]["message"]


WRONG_RANGES = [
    None, "0-3", {"0": 3}, [], [3], [[0]], [[0, 1, 2]], [["0", "3"]], [[0.0, 3.0]], [[False, True]],
    [[-1, 3]], [[3, 3]], [[3, 2]], [[0, 101]], [[100, 101]], [[0, 2**80]], [[-(2**80), 3]],
    [[[0, 3]]], [None], [[0, 3], [0, 101]], [[0, None]],
]  # fmt: skip


@pytest.mark.parametrize("ranges", WRONG_RANGES, ids=repr)
def test_what_is_no_range_of_the_file_is_refused_and_nothing_read(page, ranges):
    source = Source(bytes(100))
    content, buffers = page.ask(channel_of(source, page).take, "ranges", ranges=ranges)
    assert content["error"]["name"] == "InvalidArgumentError"
    assert re.fullmatch(r"found .*, expected .*", content["error"]["message"])
    assert len(content["error"]["message"]) <= 400
    assert source.asked == buffers == []


@pytest.mark.parametrize(
    ("ranges", "line"),
    [
        ([[0, 1]] * (MOST_RANGES + 1), f"{MOST_RANGES + 1} ranges are more than {MOST_RANGES}"),
        ([[0, MOST_BYTES + 1]], f"{MOST_BYTES + 1} bytes are more than {MOST_BYTES}"),
        ([[0, MOST_BYTES], [5, 6]], f"{MOST_BYTES + 1} bytes are more than {MOST_BYTES}"),
    ],
    ids=["ranges", "one range", "bytes"],
)
def test_more_than_a_message_may_ask_is_refused_and_nothing_read(page, ranges, line):
    source = Source(b"")
    source.size = 2 * MOST_BYTES
    content, _ = page.ask(channel_of(source, page).take, "ranges", ranges=ranges)
    assert content["error"]["name"] == "LimitExceededError"
    assert line in content["error"]["message"]
    assert source.asked == []


def test_questions_without_end_are_refused_until_others_are_answered(page, gate):
    channel = Channel(page.send, {"wait": lambda _: gate.wait(PATIENCE) and Answer({}, [])}, {})
    for number in range(MOST_WAITING):
        channel.take({"id": str(number), "what": "wait"})
    content, _ = page.ask(channel.take, "wait", "one more")
    assert content["error"]["name"] == "LimitExceededError"
    gate.set()
    for number in range(MOST_WAITING):
        assert page.answer(str(number))[0] == {"id": str(number)}
    assert page.ask(channel.take, "wait", "again")[0] == {"id": "again"}


def test_a_file_comes_byte_by_byte(terrain, twz, page):
    widget = explored(terrain, page)
    told, _ = page.ask(widget._channel.take, "terrain", "about")
    assert told["size"] == twz.stat().st_size
    _, (data,) = page.ask(widget._channel.take, "ranges", ranges=[[0, told["size"]]])
    assert data == twz.read_bytes()


def test_bytes_of_servers_and_private_stores_come_too(twz, page):
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    memory.pipe("/explored.twz", twz.read_bytes())
    with static_server(twz.parent) as server:
        for url in (f"{server.address}/hills.twz", "memory://explored.twz"):
            with terrainwave.open(url) as terrain:
                take = explored(terrain, page)._channel.take
                _, (data,) = page.ask(take, "ranges", url[:9], ranges=[[100, 900]])
                assert data == twz.read_bytes()[100:900]
    memory.rm("/explored.twz")


def test_what_the_page_is_told_names_no_path(terrain, twz, page):
    told, _ = page.ask(explored(terrain, page)._channel.take, "terrain")
    assert str(twz.parent) not in repr(told)
    assert told["terrain"]["error"] == 2
    assert told["terrain"]["bounds"] == pytest.approx(BOUNDS)
    assert "rows" in told["terrain"]["placed"]


def region_at(terrain, box):
    return region_of_box(Globe(terrain), box)


def test_a_box_becomes_the_samples_whose_pixels_it_touches(terrain):
    for box in [
        (8.1, 46.1, 8.2, 46.3),
        (8.0001, 46.0001, 8.01, 46.01),
        (8.203, 46.203, 8.203, 46.203),
    ]:
        west, south, east, north = box
        asked = (west, south, max(east, west + 1e-6), max(north, south + 1e-6))
        assert region_at(terrain, box) == terrain.region(bounds=asked)


@pytest.mark.parametrize(
    ("crs", "bounds", "box"),
    [
        ("EPSG:32633", (250000, 6990000, 259000, 6999000), (10.2, 62.95, 10.25, 63.0)),
        ("EPSG:3031", (-2e6, -2e6, 2e6, 2e6), (-170, -89, 170, -86)),
        ("EPSG:3031", (-2e6, -2e6, 2e6, 2e6), (30, -80, 60, -78)),
        ("EPSG:4326", (179.6, -17.0, 180.2, -16.6), (179.8, -16.9, 180.1, -16.8)),
        ("EPSG:4326", (179.6, -17.0, 180.2, -16.6), (-180.2, -16.9, -179.9, -16.8)),
        ("EPSG:4326", (0.0, -90.0, 360.0, 90.0), (-30.0, 10.0, -20.0, 20.0)),
    ],
)
def test_a_window_holds_all_samples_in_its_box_and_few_others(tmp_path, crs, bounds, box):
    """Where samples lie is PROJ's word, by rasterio."""
    twz = write_twz(tmp_path, hills(90, 100), bounds, crs)
    with terrainwave.open(twz) as terrain:
        region = region_at(terrain, box)
        x, y = terrain.coordinates(window=(0, 0, *terrain.shape))
    lon, lat = (np.array(v) for v in transform(crs, "EPSG:4326", x.ravel(), y.ravel()))
    west, south, east, north = box
    inside = (np.mod(lon - west, 360) <= east - west) & (lat >= south) & (lat <= north)
    rows, cols = np.nonzero(inside.reshape(90, 100))
    assert len(rows)
    row, col, n_rows, n_cols = region
    assert row <= rows.min() <= row + 1
    assert col <= cols.min() <= col + 1
    assert row + n_rows - 2 <= rows.max() < row + n_rows
    assert col + n_cols - 2 <= cols.max() < col + n_cols


@pytest.mark.parametrize(
    "box",
    [(0, 0, 1, 1), (8.1, 10, 8.2, 20), (20, 46.1, 30, 46.2)],
)
def test_a_box_beside_the_terrain_is_refused_and_the_window_stays(terrain, page, box):
    widget = explored(terrain, page)
    widget.window = (3, 4, 5, 6)
    content, _ = page.ask(widget._channel.take, "draw", box=list(box))
    assert "does not overlap the terrain" in content["error"]["message"]
    assert widget.window == (3, 4, 5, 6)


@pytest.mark.parametrize(
    "box",
    [
        5, "box", [], [1, 2, 3], [1, 2, 3, 4, 5], [8.2, 46.1, 8.1, 46.2], [8.1, 46.2, 8.2, 46.1],
        [8, 46, 9, "47"], [8, 46, 9, None], [float("nan"), 46, 9, 47], [8, 46, float("inf"), 47],
        [8, -91, 9, 47], [0, 0, 361, 1], [True, 46, 9, 47], {"west": 8}, [1e300, 46, 1e300, 47],
    ],
    ids=repr,
)  # fmt: skip
def test_what_is_no_box_is_refused_in_one_line(terrain, page, box):
    widget = explored(terrain, page)
    content, _ = page.ask(widget._channel.take, "draw", box=box)
    assert content["error"]["name"] == "InvalidArgumentError"
    assert widget.window is None


def test_a_drawn_window_is_what_read_takes(terrain, page):
    widget, seen = explored(terrain, page), []
    assert widget.window is None
    widget.observe(lambda change: seen.append(change["new"]), "window")
    page.ask(widget._channel.take, "draw", box=[8.1, 46.1, 8.2, 46.3])
    expected = terrain.read(bounds=(8.1, 46.1, 8.2, 46.3))
    np.testing.assert_array_equal(terrain.read(window=widget.window), expected)
    assert widget.window.shape == expected.shape
    assert seen == [widget.window]
    page.ask(widget._channel.take, "draw", "2", box=None)
    assert widget.window is None


@pytest.mark.parametrize("window", [5, "all", (1, 2, 3), (0, 0, 0, 4), (100, 0, 3, 3)])
def test_a_wrong_window_is_refused_and_the_old_one_stays(terrain, window):
    widget = terrain.explore()
    widget.window = (1, 2, 3, 4)
    with pytest.raises(terrainwave.InvalidArgumentError, match="window"):
        widget.window = window
    assert widget.window == (1, 2, 3, 4)


CAMERA = {"lon": 8.2, "lat": 46.1, "zoom": 11.5, "pitch": 40, "bearing": -20}


def test_a_camera_is_taken_from_python_and_from_the_page(terrain):
    widget = terrain.explore(camera=CAMERA)
    assert widget.camera == CAMERA
    widget.camera = widget.camera | {"zoom": np.float32(9.5)}
    assert widget.camera["zoom"] == 9.5
    assert {type(value) for value in widget.camera.values()} == {float}
    widget.set_state({"camera": CAMERA})  # as ipywidgets does for the page
    assert widget.camera == CAMERA


def test_a_raster_without_a_place_is_refused_with_what_shows_it():
    data = terrainwave.compress_to_bytes(terrain_like(40, 50), max_error=1, block=32, mesh="none")
    with terrainwave.open(data) as terrain:
        with pytest.raises(terrainwave.InvalidHeightsError) as caught:
            terrain.explore()
    assert str(caught.value) == (
        "the raster has no coordinate reference system, and no coordinates that fit degrees: it has"
        " no place on a globe. Name its CRS, for example by gdal_edit -a_srs, and compress it"
        " again; terrain.view() shows it"
    )


def test_without_widgets_there_is_the_picture(terrain):
    widget = terrain.explore()
    data, _ = widget._repr_mimebundle_()
    assert data["application/vnd.jupyter.widget-view+json"]["model_id"] == widget.model_id
    assert data["text/html"] == terrain._repr_html_()
    assert data["text/plain"] == f"<Explorer of {terrain!r}>"


HOSTILE = [
    None, 5, "ranges", [], [["id", "1"]], {}, {"what": "ranges"}, {"id": 1, "what": "ranges"},
    {"id": "", "what": "ranges"}, {"id": "x" * 81, "what": "ranges"}, {"id": ["1"], "what": "x"},
]  # fmt: skip


@pytest.mark.parametrize("message", HOSTILE, ids=repr)
def test_a_message_without_an_id_is_refused(page, message):
    channel_of(Source(b"abc"), page).take(message)
    ((content, buffers),) = page.sent
    assert content["id"] is None
    assert content["error"]["message"] == "found a message without an id, expected one"
    assert buffers == []
