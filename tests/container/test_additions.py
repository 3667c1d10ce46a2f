"""What a minor version may add (FORMAT.md §12.1): what must be known is refused, else ignored."""

import numpy as np
import pytest
from conformance.editor import Editor, optional_section
from strategies import terrain_like
from twz import twz_bytes

import terrainwave

HEIGHTS = terrain_like(1100, 3, seed=2)  # of several segments
DATA = twz_bytes(HEIGHTS, max_error=0, method="store", mesh="none")


def read(data):
    with terrainwave.open(data, threads=1) as terrain:
        assert list(terrain.check()) == []
        return terrain.read()


def changed(**changes):
    editor = Editor(DATA)
    for name, value in changes.items():
        setattr(editor, name, value)
    return editor.bytes()


@pytest.mark.parametrize(
    "sections",
    [
        optional_section(b"none", b"what no reader knows"),
        optional_section(b"none", b""),
        optional_section(b"\0\0\0\0", bytes(range(256))) + optional_section(b"none", b"another"),
        # Longer than what is read at first, and as long as it can be.
        optional_section(b"none", bytes(2**16 - 1 - 128 - 12)),
    ],
    ids=["one", "empty", "two", "longest"],
)
def test_optional_sections_that_are_not_known_are_ignored(sections):
    np.testing.assert_array_equal(read(changed(optional=sections)), HEIGHTS)


def test_keys_of_metadata_that_are_not_known_are_ignored():
    editor = Editor(DATA)
    editor.set_json(of_a_later_version={"a": [1, None]})
    np.testing.assert_array_equal(read(editor.bytes()), HEIGHTS)


def test_a_file_that_is_changed_has_no_sections_that_are_not_known(tmp_path):
    path = tmp_path / "a.twz"
    path.write_bytes(changed(optional=optional_section(b"none", b"what no reader knows")))
    terrainwave.store_meshes(path, tmp_path / "b.twz")
    with terrainwave.open(tmp_path / "b.twz") as terrain:
        assert terrain.container.extents.header_size == 128
