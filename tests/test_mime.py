"""Do the snippets for file(1) and for desktops say what files begin with (FORMAT.md §14)?"""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

from golden_files import GOLDEN

from terrainwave.container.header import DTYPE_CODES, FORMAT_VERSION, MAGIC, MEDIA_TYPE
from terrainwave.names import METHODS

MIME = Path(__file__).parents[1] / "tools" / "mime"


def unescaped(text):
    return re.sub(rb"\\x(..)", lambda found: bytes.fromhex(found[1].decode()), text.encode())


def test_the_snippet_of_file_knows_magic_version_methods_and_types():
    text = (MIME / "terrainwave.magic").read_text(encoding="utf-8")
    assert unescaped(re.search(r"^0\tstring\t(\S+)", text, re.M)[1]) == MAGIC
    assert f"!:mime\t{MEDIA_TYPE}\n!:ext\ttwz\n" in text
    assert f">8\tubyte\t{FORMAT_VERSION}\n" in text
    found = dict(re.findall(r"^>>34\tubyte\t(\d+)\t\\b, method (\w+)$", text, re.M))
    assert found == {str(method.number): name for name, method in METHODS.items()}
    found = dict(re.findall(r"^>>35\tubyte\t(\d+)\t\\b, (\w+)$", text, re.M))
    assert found == {str(code): name for name, code in DTYPE_CODES.items()}


def test_the_snippet_for_desktops_knows_magic_and_suffix():
    name = "{http://www.freedesktop.org/standards/shared-mime-info}"
    (kind,) = ET.parse(MIME / "terrainwave.xml").getroot()
    assert kind.get("type") == MEDIA_TYPE
    match = kind.find(f"{name}magic/{name}match")
    assert (match.get("type"), match.get("offset")) == ("string", "0")
    assert unescaped(match.get("value")) == MAGIC
    assert kind.find(f"{name}glob").get("pattern") == "*.twz"


def test_the_signature_for_droid_is_how_files_begin():
    name = "{http://www.nationalarchives.gov.uk/pronom/SignatureFile}"
    root = ET.parse(MIME / "terrainwave-droid.xml").getroot()
    (sequence,) = root.iter(f"{name}Sequence")
    begin = bytes.fromhex(sequence.text)
    assert begin == MAGIC + bytes([FORMAT_VERSION])
    (kind,) = root.iter(f"{name}FileFormat")
    assert (kind.get("MIMEType"), kind.get("Version")) == (MEDIA_TYPE, str(FORMAT_VERSION))
    assert all(path.read_bytes().startswith(begin) for path in GOLDEN.glob("v2/*.twz"))
