"""The native library: are its tables those of the annexes, and is it built as CI needs it?

`make native` builds and tests it; this needs no compiler.
"""

import re
import sys
import zlib
from pathlib import Path

import pytest
from native_header import HEADER, PROMISED, broken_promises, problems_of, read_header

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


def test_structures_are_what_the_header_says_of_them():
    header = read_header(HEADER.read_text(encoding="utf-8"))
    assert len(header.structs) > 10
    assert problems_of(header) == []


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ("  size_t size;\n  twz_allocator", "  twz_allocator", "twz_options: begin with"),
        ("  uint32_t row, col,", "  size_t size;\n  uint32_t row, col,", "twz_box: never change"),
        (" row, col, n_rows, n_cols;", " row, reserved;", "twz_box: never change, and ends with"),
        (
            "                         twz_box\n",
            "                         none\n",
            "twz_box: nothing",
        ),
    ],
)
def test_a_structure_that_is_not_as_the_header_says_is_found(before, after, problem):
    text = re.sub(r"size_t size;  +/\*", "size_t size; /*", HEADER.read_text(encoding="utf-8"))
    text = re.sub(r"size_t size; /\*.*\*/", "size_t size;", text)
    assert before in text
    found = problems_of(read_header(text.replace(before, after)))
    assert any(line.startswith(problem) for line in found), found


def test_the_library_keeps_what_the_last_header_promised():
    promised, header = (
        read_header(path.read_text(encoding="utf-8")) for path in (PROMISED, HEADER)
    )
    assert len(promised.functions) > 30
    assert broken_promises(promised, header) == []


# Of a later header: what it may change, and what it may not.
LATER = [
    ("  twz_kernels kernels;", "  twz_kernels kernels; int more;", None),
    ("  twz_kernels kernels;", "  int more; twz_kernels kernels;", "twz_options"),
    ("  uint64_t length;\n", "  uint64_t length, more;\n", "twz_range"),
    ("  uint64_t is_page;", "  double is_page;", "twz_range"),
    ("  uint64_t reserved;", "  uint64_t more;", None),
    ("row, col, n_rows, n_cols;", "row, col, n_rows, n_cols, more;", "twz_box"),
    ("  int bound_side;", "  int bound_side; int more;", None),
    ("  TWZ_CANCELLED", "  TWZ_MORE, TWZ_CANCELLED", "TWZ_CANCELLED: was 8, is 9"),
    ("  TWZ_CANCELLED", "  TWZ_CANCELLED, TWZ_MORE", None),
    (
        "void twz_file_free(twz_file *file)",
        "void twz_file_free(void)",
        "void twz_file_free(twz_file",
    ),
    ("int (*twz_fetch)(void *source,", "int (*twz_fetch)(", "int (*twz_fetch)"),
]


@pytest.mark.parametrize(("before", "after", "problem"), LATER)
def test_a_broken_promise_is_found(before, after, problem):
    text = re.sub(
        r"/\*.*?\*/", "", PROMISED.read_text(encoding="utf-8").split("*/", 1)[1], flags=re.S
    )
    first = PROMISED.read_text(encoding="utf-8").split("*/", 1)[0] + "*/"
    assert before in text
    promised = read_header(first + text)
    found = broken_promises(promised, read_header(first + text.replace(before, after, 1)))
    if problem is None:
        assert found == []
    else:
        assert len(found) == 1
        assert found[0].startswith(problem)


def test_the_soname_has_the_number_of_the_promise():
    text = (ROOT / "native" / "CMakeLists.txt").read_text(encoding="utf-8")
    assert "SOVERSION ${PROJECT_VERSION_MAJOR}" in text
    version = re.search(r"project\(terrainwave VERSION (\d+)", text)
    assert f"#define TWZ_VERSION_MAJOR {version[1]}\n" in PROMISED.read_text(encoding="utf-8")
