"""Is the module of the reader in JavaScript what its sources make?"""

import base64
import hashlib
import lzma
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WASM = ROOT / "js" / "wasm"
MODULE = ROOT / "js" / "src" / "core-data.js"
COMPILER = "clang-14"  # another one makes other bytes


def constant(path, name):
    """Return a text that a module exports."""
    found = re.search(rf'export const {name} = "([^"]+)"', path.read_text())
    assert found is not None, name
    return found[1]


def core(path):
    """Return the decoder. Another liblzma may pack it otherwise."""
    # What Python wants in front: lc 3, lp 0, pb 0; a window of 64 MiB; a size that the end tells.
    header = b"\x03" + (1 << 26).to_bytes(4, "little") + b"\xff" * 8
    return lzma.decompress(header + base64.b64decode(constant(path, "CORE")), lzma.FORMAT_ALONE)


def unpack(path):
    """Return what unpacks it."""
    return base64.b64decode(constant(path, "UNPACK"))


def test_the_module_was_made_of_these_sources():
    native = ROOT / "native"
    groups = [
        [WASM / "build.sh", WASM / "pack.py"],
        WASM.glob("*.c"),
        WASM.glob("*.h"),
        (WASM / "include").glob("*.h"),
        (native / "include").glob("*.h"),
        (native / "src").glob("*.c"),
        (native / "src").glob("*.h"),
    ]
    files = [path for group in groups for path in sorted(group)]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    assert constant(MODULE, "SOURCES") == digest, "run js/wasm/build.sh"


@pytest.mark.full
@pytest.mark.native
def test_the_module_is_what_a_fresh_build_makes(tmp_path):
    assert shutil.which(COMPILER), f"{COMPILER} is missing: tools/install_system.sh native"
    made = tmp_path / "core-data.js"
    environment = os.environ | {"OUT": str(made)}
    done = subprocess.run(
        ["sh", WASM / "build.sh"], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for unpacked in (core, unpack):
        assert unpacked(made) == unpacked(MODULE), "run js/wasm/build.sh"
