"""The native library: are its tables those of the annexes, and is it built as CI needs it?

`make native` builds and tests it; this needs no compiler.
"""

import re
import sys
import zlib
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tools"))

import make_native_tables  # noqa: E402


def inflated(text):
    """Return tables with what their zlib streams hold: other compressors make other bytes."""

    def stream(match):
        return zlib.decompress(bytes(map(int, match[1].split(",")))).hex()

    text = re.sub(r"uint8_t \w+\[\d+\] =\s*\{(120, [\d,\s]*)\};", stream, text)
    return re.sub(r"(_size\[12\] =\s*\{[^}]*|_starts_size = \d+)", "", text)


def test_tables_are_those_of_the_annexes(tmp_path, monkeypatch):
    monkeypatch.setattr(make_native_tables, "OUT", tmp_path / "tables.c")
    make_native_tables.main()
    kept = (ROOT / "native" / "src" / "tables.c").read_text()
    assert inflated((tmp_path / "tables.c").read_text()) == inflated(kept), (
        "run tools/make_native_tables.py"
    )


def test_every_source_is_built():
    builds = [ROOT / "native" / folder / "CMakeLists.txt" for folder in ("", "python")]
    listed = {name for path in builds for name in re.findall(r"\b\w+\.c\b", path.read_text())}
    sources = {path.name for path in (ROOT / "native").rglob("*.c")}
    assert sources <= listed | {"fuzz_file.c", "fuzz_unit.c"}


def test_the_library_includes_no_input_or_output_and_no_locale():
    allowed = {
        "arm_neon.h", "assert.h", "float.h", "immintrin.h", "intrin.h", "math.h", "pthread.h",
        "stdarg.h", "stddef.h", "stdint.h", "stdio.h", "stdlib.h", "string.h", "sys/mman.h",
        "unistd.h", "wasm_simd128.h", "windows.h",
    }  # fmt: skip
    for path in (ROOT / "native" / "src").iterdir():
        text = path.read_text()
        assert set(re.findall(r"#include <(.*?)>", text)) <= allowed, path.name
        # stdio is there for vsnprintf alone; numbers are read without a locale.
        assert not re.search(r"\b(fopen|fread|printf|fprintf|strtod|setlocale|getenv)\(", text), (
            path.name
        )
        static = re.findall(
            r"^static (?!const|inline|ALWAYS|twz_status|[\w ]+\*?[\w()]+\()[^(]*?[=;]", text, re.M
        )
        assert not static, (path.name, static)  # no state that changes
