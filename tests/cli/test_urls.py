"""Commands and objects that read from a web server: what they print has no secrets."""

import pickle
import zipfile
from pathlib import Path

import pytest
from commands import run
from container.test_url import running_server
from strategies import terrain_like, write_geotiff

import terrainwave

FILE = Path(__file__).parents[1] / "golden" / "v2" / "rapid-int16-states.twz"
LOGIN, QUERY = "//me:secret@", "?sig=secret"


@pytest.fixture
def address(tmp_path, monkeypatch):
    """Return a function from a path on the server to its URL, with secrets."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        archive.write(FILE, "in/my heights.twz")
    with running_server() as server:
        server.files["/h%C3%B6he%201.twz"] = FILE.read_bytes()
        server.files["/all.zip"] = (tmp_path / "all.zip").read_bytes()
        yield lambda path: server.url(path).replace("//", LOGIN) + QUERY


def printed(*command, status=0):
    result = run(*command)
    assert result.exit_code == status, result.output
    assert "secret" not in result.output
    return result.output


def test_info_names_the_file_without_secrets(address):
    assert "/höhe 1.twz" in "".join(printed("info", address("/höhe 1.twz")).split("\n"))
    printed("info", "--json", address("/höhe 1.twz"))
    printed("info", f"zip://in/my heights.twz::{address('/all.zip')}")


def test_a_batch_names_files_without_secrets(address, tmp_path):
    sources = f"zip://in/my heights.twz::{address('/all.zip')}", address("/none.twz")
    output = printed("decompress", *sources, "--to", tmp_path / "to", status=1)
    assert "404 Not Found" in output
    assert [path.name for path in (tmp_path / "to").iterdir()] == ["my heights.tif"]
    printed("decompress", address("/a.twz"), address("/b/a.twz"), "--to", tmp_path, status=2)


def test_a_raster_that_cannot_be_read_is_named_without_secrets(address, tmp_path):
    printed("compress", address("/none.tif"), tmp_path / "a.twz", status=1)


def test_a_terrain_tells_no_secrets_and_can_be_pickled(address):
    with terrainwave.open(address("/höhe 1.twz")) as terrain:
        assert "secret" not in repr(terrain) + str(terrain.name) + terrain.info().path
        with pickle.loads(pickle.dumps(terrain)) as copy:
            assert copy.shape == terrain.shape


@pytest.mark.parametrize("verb", ["patch", "compress", "decompress", "mesh"])
def test_targets_by_url_are_refused_without_their_secrets(tmp_path, verb):
    tif = write_geotiff(tmp_path / "a.tif", terrain_like(40, 40))
    twz = tmp_path / "a.twz"
    terrainwave.compress(tif, twz, max_error=1)
    ending = {"patch": "twz", "compress": "twz", "decompress": "tif", "mesh": "ply"}[verb]
    url = f"https://me:secret@host.test/folder/b.{ending}?key=secret"
    names = {"patch": (url, tif), "compress": (tif, url)}.get(verb, (twz, url))
    options = ["--max-error", "1"] if verb == "mesh" else []
    result = run(verb, *names, *options)
    assert result.exit_code in (1, 2)
    (line,) = result.stderr.strip().splitlines()
    assert "secret" not in line
    assert "expected a path" in line or "expected a name" in line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.tif", "a.twz"]


@pytest.mark.parametrize("login", ["bob:p@ssw0rd/x", "bob:pass/w@rd?y", "bob:p@ss#word"])
def test_a_password_with_bare_marks_is_neither_printed_nor_looked_up(login):
    result = run("info", f"http://{login}@127.0.0.1:9/a.twz")
    assert result.exit_code == 1
    for part in ("ssw0rd", "w@rd", "word", "p@ss"):
        assert part not in result.output.replace("password", "")
    assert "%40" in result.output or "%2F" in result.output
