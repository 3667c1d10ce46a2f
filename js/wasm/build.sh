#!/bin/sh
# Compile the kernels to WebAssembly and write them into js/src/kernels-data.js, deflated, in base 64.
# Needs clang and lld with the target wasm32 (Debian: clang-14 lld-14); CLANG names another clang.
set -eu
export LC_ALL=C # for the order of files
cd "$(dirname "$0")"
out=$(mktemp)
trap 'rm -f "$out"' EXIT
"${CLANG:-clang-14}" --target=wasm32 -O3 -msimd128 -mbulk-memory -mnontrapping-fptoint -fwrapv -ffreestanding -nostdlib \
    -Wall -Wextra -Werror -Wl,--no-entry -Wl,--strip-all -Wl,--export=__heap_base \
    -o "$out" ./*.c
{
    echo '/** js/wasm/*.c as WebAssembly, deflated, in base 64: written by js/wasm/build.sh. */'
    echo
    echo '/** Bytes of it when inflated. */'
    echo "export const SIZE = $(wc -c < "$out" | tr -d ' ');"
    echo
    echo '/** SHA-256 of build.sh, the .c and the .h files, one after the other: a test compares it. */'
    echo "export const SOURCES = \"$(cat build.sh ./*.c ./*.h | sha256sum | cut -c 1-64)\";"
    echo
    echo '// prettier-ignore'
    echo 'export const KERNELS ='
    # A gzip file is a head of 10 bytes, the deflated bytes, and 8 of checksum and size.
    gzip -9n < "$out" | tail -c +11 | head -c -8 | base64 -w 96 | sed 's/.*/  "&" +/; $s/ +$/;/'
} > ../src/kernels-data.js
