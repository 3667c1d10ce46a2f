"""The C library as one source file and its header, as SQLite and others offer themselves.

Programs copy the two files and compile them like their own. Names that several of the library's
files have for things of their own get the name of their file in front.
"""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

_HEAD = """\
/*
 * terrainwave {version}: a reader of .twz files in one source. SPDX-License-Identifier: MIT
 *
 * Made of native/src by terrainwave; change it there. Any C11 compiler builds it, without options:
 *
 *     cc -O3 -c terrainwave.c
 *
 * Define TWZ_THREADS for twz_pool, which needs threads of POSIX or Windows (cc -pthread
 * -DTWZ_THREADS). Kernels are those that every processor of the target has.
 */
#ifndef TWZ_THREADS
#define TWZ_NO_THREADS
#endif
/* For pages of memory, before any header of the system. */
#ifndef _DEFAULT_SOURCE
#define _DEFAULT_SOURCE
#endif
#ifndef _ISOC11_SOURCE
#define _ISOC11_SOURCE
#endif
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off")
#endif
"""
# Compiled several times, or not part of a reader.
_OTHER_KERNELS = {"kernels_avx2.c", "kernels_avx512.c"}
_INCLUDE = re.compile(r'\s*#\s*include "(.*)"\s*$')
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_OWN = (
    re.compile(r"^static [^;={(]*?\b(\w+) ?(?:\(|\[|=|;)", re.MULTILINE),
    re.compile(r"^(?:typedef )?(?:struct|enum|union) (\w+) \{", re.MULTILINE),
    re.compile(r"^\} (\w+);", re.MULTILINE),
)
_ENUM = re.compile(r"^(?:typedef )?enum (?:\w+ )?\{(.*?)\}", re.MULTILINE | re.DOTALL)
# Encoders belong to Python's library.
_ENCODER = re.compile(
    r"^#ifdef TWZ_ENCODER\n(?:(?!#else|#endif).*\n)*(?:#else\n((?:(?!#endif).*\n)*))?#endif\n",
    re.MULTILINE,
)
_MACRO = re.compile(r"^#define (\w+)", re.MULTILINE)


def amalgamate(native: Path, version: str) -> str:
    """Return the library in one source, which includes ``terrainwave.h``.

    Parameters
    ----------
    native
        The folder with ``src`` and ``include``.
    version
        Of the package.
    """
    paths = [
        path
        for path in sorted((native / "src").glob("*.c"))
        if not path.name.startswith("encode") and path.name not in _OTHER_KERNELS
    ]
    headers = sorted((native / "src").glob("*.h"))
    texts = {path: _text(path) for path in (*headers, *paths)}
    names = {path: _own_names(text) for path, text in texts.items()}
    n_files = Counter(name for own in names.values() for name in own)
    included: set[str] = set()
    lines = [_HEAD.format(version=version)]
    # Headers come first: a name of one file alone must not change in what all share.
    for name in ("internal.h", "rapid.h", *(header.name for header in headers)):
        if not name.startswith("encode") and not _is_template(texts[native / "src" / name]):
            lines += _included(native / "src", name, included)
    for path in paths:
        text = texts[path]
        twice = sorted(name for name in names[path] if n_files[name] > 1)
        lines.append(f"/* ==== {path.name} ==== */")
        lines += [f"#define {name} {path.stem}_{name}" for name in twice]
        own = list(_with_includes(path, text, included))
        macros = _MACRO.findall("\n".join(own))
        lines += [*own, *(f"#undef {name}" for name in dict.fromkeys([*twice, *macros]))]
    return "\n".join(lines) + "\n"


def _text(path: Path) -> str:
    return _ENCODER.sub(lambda found: found[1] or "", path.read_text(encoding="utf-8"))


def _own_names(text: str) -> set[str]:
    """Return the names at file scope that no other file sees, but for macros."""
    text = _COMMENT.sub("", text)
    found = {name for pattern in _OWN for name in pattern.findall(text)}
    for body in _ENUM.findall(text):
        found |= {item.split("=")[0].strip() for item in body.split(",")}
    return found - {""}


def _is_template(text: str) -> bool:
    """Return whether a header is included once for each set of instructions (kernels.h)."""
    return "ISA(" in text


def _with_includes(path: Path, text: str, included: set[str]) -> Iterator[str]:
    for line in text.splitlines():
        match = _INCLUDE.match(line)
        if match is None:
            yield line
        else:
            yield from _included(path.parent, match[1], included)


def _included(folder: Path, name: str, included: set[str]) -> Iterator[str]:
    path, is_first = folder / name, name not in included
    included.add(name)
    if not path.is_file():  # the public header, a file of its own
        yield from [f'#include "{name}"'] if is_first else []
        return
    text = _text(path)
    if is_first or _is_template(text):
        yield from _with_includes(path, text, included)
