"""Are the compiled kernels of the reader in JavaScript those of the sources beside them?"""

import hashlib
import re
from pathlib import Path

JS = Path(__file__).parents[1] / "js"


def test_kernels_were_compiled_from_these_sources():
    wasm = JS / "wasm"
    files = [wasm / "build.sh", *sorted(wasm.glob("*.c")), *sorted(wasm.glob("*.h"))]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    compiled = (JS / "src" / "kernels-data.js").read_text()
    told = re.search(r'SOURCES = "(\w+)"', compiled)
    assert told is not None
    assert told[1] == digest, "run js/wasm/build.sh"
