"""``-o``: options of methods and meshes on the command line."""

import pytest
from commands import run
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.codec import method_options
from terrainwave.names import MESH_KINDS, METHODS
from terrainwave.tri import mesh_options

SETS = [method_options.options_of(method) for method in METHODS]
SETS += [kind for kind in map(mesh_options.options_of, MESH_KINDS) if kind is not None]
SETS = [kind for kind in SETS if kind.names()]


@pytest.fixture
def dem(tmp_path):
    return write_geotiff(tmp_path / "dem.tif", terrain_like(60, 70), units=("m",))


def compressed(dem, *words):
    target = dem.parent / "out.twz"
    done = run(
        "compress", dem, target, "--max-error", 1, "--block", 32, "--quiet", "--overwrite", *words
    )
    assert done.exit_code == 0, done.output
    return target.read_bytes()


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (
            "--method cdf97 -o faithful -o border_rings=3",
            {"method": terrainwave.Cdf97(faithful=True, border_rings=3)},
        ),
        (
            "--method store -o border-rings=3 --mesh zerotree -o labels=layer",
            {
                "method": terrainwave.Store(border_rings=3),
                "mesh": terrainwave.Zerotree(labels="layer"),
            },
        ),
        (
            "-o border_rings=3 --effort best",
            {"method": terrainwave.Predictive(border_rings=3), "effort": "best"},
        ),
        (
            "--method cdf53 --mesh rqt -o select=coefficient",
            {"method": "cdf53", "mesh": terrainwave.Rqt(select="coefficient")},
        ),
    ],
)
def test_options_are_those_of_python(dem, tmp_path, words, options):
    other = tmp_path / "other.twz"
    terrainwave.compress(dem, other, max_error=1, block=32, **options)
    assert compressed(dem, *words.split()) == other.read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-o labels=layer", "found -o labels=layer and no --mesh, expected --mesh zerotree"),
        ("-o select=error --mesh none", "found -o select=error and --mesh none, expected --mesh"),
        ("--no-mesh --mesh rqt", "found --no-mesh and --mesh, expected one of them"),
        ("-o foo=1", "found -o foo=1, expected an option of --mesh zerotree or rqt (see"),
        ("-o foo --method cdf97 --mesh rqt", "expected -o border_rings, faithful or select (see"),
        (
            "-o border_rings=3",
            "found -o border_rings=3 and no --method, expected --method predictive, ",
        ),
        ("-o border_rings=x --method store", "found -o border_rings=x, expected 1 or 3"),
        (
            "-o border_rings --method store",
            "found -o border_rings without a value, expected -o border_rings=1|3",
        ),
        ("--method cdf97 -o faithful=no", "found -o faithful=no, expected -o faithful alone"),
        ("-o border_rings=1 -o border-rings=3", "found -o border_rings twice, expected it once"),
        ("--faithful --method cdf97", "No such option '--faithful'"),
        ("-o =3", "found -o =3, expected NAME or NAME=VALUE"),
        (
            "--mesh zerotree-plain",
            "'--mesh': 'zerotree-plain' is not one of 'halves', 'zerotree', 'rqt'",
        ),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path, dem, words, message):
    done = run("compress", dem, tmp_path / "a.twz", *words.split())
    assert done.exit_code == 2
    (line,) = (line for line in done.stderr.splitlines() if not line.startswith("note:"))
    assert message in line
    assert not (tmp_path / "a.twz").exists()


def test_stored_meshes_take_options_of_their_kind(tmp_path, dem):
    terrainwave.compress(dem, tmp_path / "a.twz", max_error=1, block=32, mesh="none")
    terrainwave.store_meshes(
        tmp_path / "a.twz", tmp_path / "b.twz", mesh=terrainwave.Zerotree(labels="layer")
    )
    options = "--store --mesh zerotree -o labels=layer"
    done = run("mesh", tmp_path / "a.twz", tmp_path / "c.twz", *options.split())
    assert done.exit_code == 0, done.output
    assert (tmp_path / "c.twz").read_bytes() == (tmp_path / "b.twz").read_bytes()
    text = run("mesh", "--mesh", "zerotree", "--help").stdout
    assert "-o labels=plain|layer|coded" in text.split("Options of --mesh zerotree:")[1]
