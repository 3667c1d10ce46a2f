"""Reads native/include/terrainwave.h: its declarations, and what a later one may not change.

A program that was built with an older header hands its structures to a newer library. So members
stay where they are, and new ones come at the end of structures that begin with their size or belong
to the library, or in the place of `reserved`.
"""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
HEADER = ROOT / "native" / "include" / "terrainwave.h"
PROMISED = ROOT / "native" / "tests" / "abi" / "terrainwave.h"
_SIZED, _RESERVED = "begin with their size, and may grow", "have fields `reserved` for more"
_LIBRARY, _FIXED = "belong to the library, and may grow", "never change"


class Member(NamedTuple):
    """Member of a structure: its declaration without a name and an array's length, and these."""

    type: str
    name: str
    n: int


class Header(NamedTuple):
    """Declarations of a header; `kinds` has what its first comment says of structures."""

    kinds: dict[str, str]
    structs: dict[str, list[Member]]
    enums: dict[str, int]
    functions: set[str]
    types: set[str]


def read_header(text: str) -> Header:
    """Return the declarations of a header's text."""
    said = re.findall(r"^ \*   (\w[^:\n]*?): +((?:twz_\w+(?:, )?)+)$", text, re.M)
    kinds = {name: kind for kind, names in said for name in names.split(", ")}
    code = re.sub(r"/\*.*?\*/", " ", text, flags=re.S)
    code = re.sub(r"^#.*?(?<!\\)$", "", code, flags=re.M | re.S)
    structs = {
        name: [member for part in body.split(";") if part.strip() for member in _members(part)]
        for body, name in re.findall(r"typedef struct \w+ \{(.*?)\} (\w+);", code, re.S)
    }
    enums: dict[str, int] = {}
    for body in re.findall(r"typedef enum \w+ \{(.*?)\} \w+;", code, re.S):
        value = -1
        for part in filter(None, map(str.strip, body.split(","))):
            name, _, stated = part.partition("=")
            value = int(stated) if stated else value + 1
            enums[name.strip()] = value
    functions = {_plain(found) for found in re.findall(r"TWZ_API ([^;]*\([^;]*\));", code)}
    types = {_plain(found) for found in re.findall(r"typedef (?!struct \w+ \{|enum)([^;]*);", code)}
    return Header(kinds, structs, enums, functions, types)


def _plain(text: str) -> str:
    return " ".join(text.split())


def _members(text: str) -> list[Member]:
    text = _plain(text)
    if pointer := re.fullmatch(r"(.*)\(\*(\w+)\)(\(.*\))", text):
        return [Member(f"{pointer[1]}(*){pointer[3]}", pointer[2], 1)]
    first, *others = text.split(",")
    head = re.fullmatch(r"(.*?[\s*])(\w+)(?:\[(\d+)\])?", first)
    assert head, text
    kind = head[1].strip()
    found = [Member(kind, head[2], int(head[3] or 1))]
    for other in others:
        stars, name, n = re.fullmatch(r"\s*(\**)(\w+)(?:\[(\d+)\])?", other).groups()
        found.append(Member(kind.rstrip("* ") + (" *" if stars else ""), name, int(n or 1)))
    return found


def problems_of(header: Header) -> list[str]:
    """Return where the structures of a header are not what its first comment says of them."""
    found = [f"{name}: nothing is said of it" for name in header.structs.keys() - header.kinds]
    found += [f"{name}: is not declared" for name in header.kinds.keys() - header.structs]
    for name, members in header.structs.items():
        kind, first = header.kinds.get(name), members[0]
        if (kind == _SIZED) != (first == Member("size_t", "size", 1)):
            found.append(f"{name}: {kind}, and begins with {first.type} {first.name}")
        if (kind == _RESERVED) != (members[-1].name == "reserved"):
            found.append(f"{name}: {kind}, and ends with {members[-1].name}")
    return found


def broken_promises(old: Header, new: Header) -> list[str]:
    """Return what a program that was built with the header `old` cannot rely on any more."""
    found = [f"{text}: is gone or another" for text in sorted(old.functions - new.functions)]
    found += [f"{text}: is gone or another" for text in sorted(old.types - new.types)]
    found += [
        f"{name}: was {value}, is {new.enums.get(name)}"
        for name, value in old.enums.items()
        if new.enums.get(name) != value
    ]
    for name, before in old.structs.items():
        after, kind = new.structs.get(name, []), old.kinds[name]
        if kind == _RESERVED:
            good = _fills_reserved(before, after)
        elif kind == _FIXED:
            good = after == before
        else:
            good = after[: len(before)] == before
        if not good or new.kinds.get(name) != kind:
            found.append(f"{name}: another layout")
    return found


def _fills_reserved(before: list[Member], after: list[Member]) -> bool:
    """Return whether members only take the place of reserved ones of their size."""
    *kept, spare = before
    if after[: len(kept)] != kept:
        return False
    is_pointer = spare.type.endswith("*")
    for member in after[len(kept) :]:
        if member.name != "reserved" and is_pointer != ("*" in member.type):
            return False
        if not is_pointer and member.type not in ("uint64_t", "double"):
            return False
    return sum(member.n for member in after[len(kept) :]) == spare.n
