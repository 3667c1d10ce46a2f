"""Two steps of build.sh, which packs the module as a whole.

python pack.py tables IN OUT                native/src/tables.c, its zlib streams stored
python pack.py module CORE UNPACK SHA OUT   core-data.js
"""

import base64
import lzma
import re
import sys
import zlib
from pathlib import Path

STREAM = re.compile(r"uint8_t (family_\d|twz_\w+_starts)\[(\d+)\] =\s*\{(120,[^}]*)\};")
SIZES = re.compile(r"size_t (twz_\w+_size(?:\[6\])?) =\s*\{?([\d,\s]+)\}?;")
N_STREAMS = 8
# What unpack.c takes. The header is left out.
FILTER = {"id": lzma.FILTER_LZMA1, "preset": 9 | lzma.PRESET_EXTREME, "lc": 3, "lp": 0, "pb": 0}
HEADER = 13


def stored_tables(text):
    """Return tables.c with stored streams: what is deflated already cannot be packed any more."""
    sizes = {}

    def stored(found):
        name, size, numbers = found.groups()
        stream = zlib.compress(zlib.decompress(bytes(map(int, numbers.split(",")))), 0)
        sizes[int(size)] = len(stream)
        return f"uint8_t {name}[{len(stream)}] = {{{','.join(map(str, stream))}}};"

    def resized(found):
        listed = (sizes.get(int(number), int(number)) for number in found[2].split(","))
        return f"size_t {found[1]} = {{{','.join(map(str, listed))}}};"

    text, n_found = STREAM.subn(stored, text)
    if n_found != N_STREAMS:
        sys.exit(f"tables.c: found {n_found} zlib streams, expected {N_STREAMS}: see pack.py")
    return SIZES.sub(resized, text)


def text_of(data):
    """Return bytes in base 64."""
    return base64.b64encode(data).decode()


def module(core, unpack, digest):
    """Return the text of core-data.js."""
    packed = lzma.compress(core, lzma.FORMAT_ALONE, filters=[FILTER])[HEADER:]
    return f"""\
/** native/src and js/wasm as WebAssembly, in base 64, written by js/wasm/build.sh. */
/** SHA-256 of what it was made of, which a test compares. */
export const SOURCES = "{digest}";
/** A module that unpacks the other one, and the latter's size then: LZMA without a header. */
// prettier-ignore
export const UNPACK = "{text_of(unpack)}";
export const N_BYTES = {len(core)};
// prettier-ignore
export const CORE = "{text_of(packed)}";
"""


def main():
    """Do a step."""
    step, *words = sys.argv[1:]
    if step == "tables":
        source, target = map(Path, words)
        target.write_text(stored_tables(source.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        core, unpack = (Path(word).read_bytes() for word in words[:2])
        Path(words[3]).write_text(module(core, unpack, words[2]), encoding="utf-8")


if __name__ == "__main__":
    main()
