"""What type checkers tell users of the package."""

import inspect
import re
from pathlib import Path

import pytest
from commands import environment, python_with

import terrainwave

SOURCES = Path(terrainwave.__file__).parents[1]
PROGRAM = """\
import terrainwave as tw

with tw.open("a.twz", cache_bytes=1 << 20, threads=1, native=False) as terrain:
    reveal_type(terrain.read(level=-2) + 1)
    reveal_type(terrain.transform)
tw.open("a.twz", thread=1)
tw.open("a.twz", cache_bytes="1 GB")
terrain.read(levl=-2)
terrain.mesh(max_eror=1)
"""
EXPECTED = {
    4: r"Revealed type is \"numpy.ndarray\[.*integer\[Any\] \| numpy.floating\[Any\]\]\]",
    5: r"Revealed type is \"affine.Affine\"",
    6: r'Unexpected keyword argument "thread" for "open"; did you mean "threads"\?',
    7: r'Argument "cache_bytes" to "open" has incompatible type "str"; expected "int"',
    8: r'Unexpected keyword argument "levl" for "read" of "TerrainFile"; did you mean "level"\?',
    9: r'Unexpected keyword argument "max_eror" for "mesh" of "Terrain"',
}


@pytest.mark.full  # mypy reads the whole package: 15 s
def test_mypy_tells_users_of_wrong_keywords_and_of_the_types_of_heights(tmp_path):
    (tmp_path / "user.py").write_text(PROGRAM)
    arguments = ["--strict", "--config-file=", "--follow-imports=silent", "user.py"]
    done = python_with(
        ["-m", "mypy", *arguments], cwd=tmp_path, env=environment(MYPYPATH=str(SOURCES))
    )
    told = dict(
        re.findall(r"^user\.py:(\d+): (?:note|error): (?!.* defined in)(.*)$", done.stdout, re.M)
    )
    assert told.keys() == {str(line) for line in EXPECTED}, done.stdout + done.stderr
    for line, text in EXPECTED.items():
        assert re.search(text, told[str(line)])


def test_open_has_the_signature_of_terrain():
    of_open = inspect.signature(terrainwave.open).parameters
    assert of_open == inspect.signature(terrainwave.Terrain).parameters
