#!/bin/sh
# Compile native/src with js/wasm to WebAssembly, and write it into js/src/core-data.js: gzip in base 64.
# Needs clang and lld with the target wasm32 (Debian: clang-14 lld-14); CLANG names another clang, OUT another file.
set -eu
cd "$(dirname "$0")"
out=${OUT:-../src/core-data.js}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
names="border bytes cdf53 cdf97 file header heights inflate json kernels kernels_baseline mask metadata payload
    predictive rapid segment store tables window"
sources=
for name in $names; do sources="$sources ../../native/src/$name.c"; done
# A stack that overflows meets the end of the memory, not data.
"${CLANG:-clang-14}" --target=wasm32 -std=c11 -O3 -flto -msimd128 -mbulk-memory -mnontrapping-fptoint -msign-ext -ffp-contract=off \
    -ffreestanding -nostdlib -nostdlibinc -fvisibility=hidden -Wall -Wextra -Werror -Wno-pass-failed -DTWZ_NO_THREADS \
    -I include -I ../../native/include -I ../../native/src \
    -Wl,--no-entry,--strip-all,--stack-first,-z,stack-size=1048576,--max-memory=2147483648 \
    -o "$work/core.wasm" host.c libc.c $sources
{
    echo '/** native/src and js/wasm as WebAssembly, gzip in base 64: written by js/wasm/build.sh. */'
    echo
    echo '// prettier-ignore'
    echo 'export const CORE ='
    gzip -9n < "$work/core.wasm" | base64 -w 96 | sed 's/.*/  "&" +/; $s/ +$/;/'
} > "$work/core-data.js"
mv "$work/core-data.js" "$out"
