#!/bin/sh
# Compile native/src with js/wasm to WebAssembly, and write it into js/src/core-data.js: LZMA in base 64.
# Needs clang and lld with the target wasm32 (Debian: clang-14 lld-14) and Python; CLANG and PYTHON name others, OUT another file.
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
"${PYTHON:-python3}" pack.py tables ../../native/src/tables.c "$work/tables.c"
compile libc.c -Oz -fno-builtin
compile host.c -Oz
fast="-O2 -fno-unroll-loops -mllvm -inline-threshold=10"
for name in kernels_baseline predictive heights mask; do compile "../../native/src/$name.c" $fast; done
compile root.c $fast
compile ../../native/src/cdf97.c $fast -fno-vectorize
for name in border bytes cdf53 file header inflate json kernels metadata payload rapid segment store window; do
    compile "../../native/src/$name.c" -Oz
done
compile "$work/tables.c" -Oz

# A stack that overflows meets the end of the memory, not data.
"${CLANG:-clang-14}" --target=wasm32 -nostdlib \
    -Wl,--no-entry,--strip-all,--stack-first,-z,stack-size=1048576,--max-memory=2147483648 \
    -o "$work/core.wasm" "$work"/*.o
# In two steps: where it links with -Oz, clang runs wasm-opt if a machine has that, and makes other bytes.
"${CLANG:-clang-14}" --target=wasm32 -std=c11 -mbulk-memory -msign-ext -ffreestanding -fno-builtin \
    -fvisibility=hidden -Wall -Wextra -Werror -Oz -o "$work/unpack.o" -c unpack.c
"${CLANG:-clang-14}" --target=wasm32 -nostdlib -Wl,--no-entry,--strip-all,-z,stack-size=4096 \
    -o "$work/unpack.wasm" "$work/unpack.o"
digest=$(cat build.sh pack.py ./*.c ./*.h include/*.h ../../native/include/*.h ../../native/src/*.c ../../native/src/*.h |
    sha256sum | cut -c 1-64)
"${PYTHON:-python3}" pack.py module "$work/core.wasm" "$work/unpack.wasm" "$digest" "$work/core-data.js"
mv "$work/core-data.js" "$out"
