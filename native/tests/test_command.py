"""Test the command `twz` on files by anyone: python native/tests/test_command.py TWZ.

Needs Python's own library only. What `twz` decodes is tested by the conformance set.
"""

import json
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

GOLDEN = Path(__file__).parents[2] / "tests" / "golden" / "v2"
CONTROLS = "\x7f\x80\x9b31m\x9f\u061c\u200b\u200e\u2028\u202e\u2066\ufeff"


def with_metadata(data, text):
    """Return a file with other metadata; its sections lie where they lay from the start on."""
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    section = stream.compress(text) + stream.flush()
    before = struct.unpack_from("<I", data, 76)[0]
    more = len(section) - before
    header = bytearray(data[:124])
    struct.pack_into("<Q", header, 16, len(data) + more)
    struct.pack_into("<I", header, 76, len(section))
    struct.pack_into("<I", header, 104, zlib.crc32(section))
    return bytes(header) + struct.pack("<I", zlib.crc32(header)) + section + data[128 + before :]


def run(*command):
    """Return what a command writes and its status."""
    done = subprocess.run(command, capture_output=True, check=False)
    return done.stdout.decode(), done.stderr.decode(), done.returncode


def check(twz, folder):
    """Yield what is wrong."""
    plain = (GOLDEN / "one-sample.twz").read_bytes()
    path = folder / "controls.twz"
    described = {"description": f"a{CONTROLS}b", "tags": {f"k{CONTROLS}": f"v{CONTROLS}"}}
    text = json.dumps(described, ensure_ascii=False).encode()
    path.write_bytes(with_metadata(plain, text.replace(b", ", b",\n\t")))
    shown, errors, status = run(*twz, "info", path)
    if status or errors or any(one in shown for one in set(CONTROLS) - set("31m")):
        yield f"info: {status} {errors!r} {shown!r}"
    shown, errors, status = run(*twz, "info", path, "--json")
    if status or errors or any(one in shown for one in set(CONTROLS) - set("31m")):
        yield f"info --json: {status} {errors!r} {shown!r}"
    elif json.loads(shown)["metadata"] != described:
        yield f"info --json: {shown!r}"
    for name, is_told in (("rapid-int16-halves", True), ("rapid-uint8", False)):
        shown, errors, status = run(*twz, "check", GOLDEN / f"{name}.twz")
        has_note = "note: " in errors and "meshes (halves) were not checked" in errors
        if status or shown or has_note != is_told or (errors and not is_told):
            yield f"check {name}: {status} {shown!r} {errors!r}"
    for name, words in (
        ("segment-gap", "a segment's body ends at byte"),
        ("neighbours-differ", "which they share"),
        ("mesh-crc", "the checksum of a payload or mesh"),
    ):
        shown, errors, status = run(*twz, "check", GOLDEN / "invalid" / f"{name}.twz")
        if status != 1 or words not in errors:
            yield f"check {name}: {status} {errors!r}"


def main():
    """Print what is wrong, and say by the status whether anything is."""
    with tempfile.TemporaryDirectory() as folder:
        found = list(check(sys.argv[1:], Path(folder)))
    print("\n".join(found))
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
