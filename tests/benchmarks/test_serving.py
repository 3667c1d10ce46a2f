"""Does the load on `terrainwave serve` find a server that answers, and count what it should?"""

from faults import serving


def test_requests_are_counted_by_kind_and_status():
    requests = [["a", 10.0, 200], ["a", 30.0, 503], ["b", 20.0, 404], ["b", 5.0, 0], ["b", 9.0, -1]]
    a, b, everything = serving.rows_of(requests, 2.0)
    assert a == serving.Row("a", 2, 1.0, 10.0, 10.0, 1, 0, 1, 0, 0, 0)
    assert (b.n_4xx, b.n_lost, b.n_hung, b.median_ms) == (1, 1, 1, 20.0)
    assert everything.requests == 5
