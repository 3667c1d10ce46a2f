#!/bin/sh
# Compile native/src with js/wasm to WebAssembly, and write it into js/src/core-data.js: gzip in base 64.
# Needs clang and lld with the target wasm32 (Debian: clang-14 lld-14, zopfli for what is committed); CLANG names another clang, OUT another file.
set -eu
export LC_ALL=C # for the order of files
cd "$(dirname "$0")"
out=${OUT:-../src/core-data.js}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# compile FILE OPTIONS
compile() {
    file=$1
    shift
    "${CLANG:-clang-14}" --target=wasm32 -std=c11 -msimd128 -mbulk-memory -mnontrapping-fptoint -msign-ext \
        -ffp-contract=off -nostdlibinc -fvisibility=hidden -Wall -Wextra -Werror -Wno-pass-failed -DTWZ_NO_THREADS \
        -I include -I ../../native/include -I ../../native/src "$@" -c "$file" -o "$work/$(basename "$file" .c).o"
}

# Loops over samples are compiled for speed, all else for size. (libc.c must not call what it defines.)
compile libc.c -Oz -fno-builtin
compile host.c -Oz
fast="-O2 -fno-unroll-loops -mllvm -inline-threshold=10"
for name in kernels_baseline predictive heights mask; do compile "../../native/src/$name.c" $fast; done
compile ../../native/src/cdf97.c $fast -fno-vectorize
for name in border bytes cdf53 file header inflate json kernels metadata payload rapid segment store tables window; do
    compile "../../native/src/$name.c" -Oz
done
# Zopfli, where it is installed, finds a gzip file that is 4 % smaller; the module is the same.
packed() {
    if command -v zopfli >/dev/null; then zopfli --i15 -c "$1"; else gzip -9nc "$1"; fi
}

# A stack that overflows meets the end of the memory, not data.
"${CLANG:-clang-14}" --target=wasm32 -nostdlib \
    -Wl,--no-entry,--strip-all,--stack-first,-z,stack-size=1048576,--max-memory=2147483648 \
    -o "$work/core.wasm" "$work"/*.o
{
    echo '/** native/src and js/wasm as WebAssembly, gzip in base 64: written by js/wasm/build.sh. */'
    echo '/** SHA-256 of what it was made of, which a test compares. */'
    echo "export const SOURCES = \"$(cat build.sh ./*.c include/*.h ../../native/include/*.h ../../native/src/*.c \
        ../../native/src/*.h | sha256sum | cut -c 1-64)\";"
    echo '// prettier-ignore'
    echo "export const CORE = \"$(packed "$work/core.wasm" | base64 -w 0)\";"
} > "$work/core-data.js"
mv "$work/core-data.js" "$out"
