#!/bin/sh
# Install a build, and build examples/c with what is installed: by pkg-config, and by find_package of CMake.
#   sh native/tests/installed.sh BUILD PREFIX shared|static
set -eu
build=$1 kind=$3
# CMake looks for a relative prefix below its sources.
case $2 in /*) prefix=$2 ;; *) prefix=$(pwd)/$2 ;; esac
root=$(cd "$(dirname "$0")/../.." && pwd)
file=$root/tests/golden/v2/rapid-int16-halves.twz
rm -rf "$prefix" "$prefix.moved"
cmake --install "$build" --prefix "$prefix" >/dev/null
mv "$prefix" "$prefix.moved" # a prefix need not stay where it was installed
prefix=$prefix.moved
PKG_CONFIG_PATH=$(dirname "$(find "$prefix" -name terrainwave.pc)")
export PKG_CONFIG_PATH
libraries=$(pkg-config --variable=libdir terrainwave)
if [ "$kind" = shared ]; then
    readelf -d "$libraries/libterrainwave.so" | grep -F "Library soname: [libterrainwave.so.1]" >/dev/null
    [ -e "$libraries/libterrainwave.so.1" ]
    # All names are those of the interface.
    nm -D --defined-only "$libraries/libterrainwave.so" | grep -v " twz_" && exit 1
else
    [ -e "$libraries/libterrainwave.a" ]
fi
for example in window points; do
    # shellcheck disable=SC2046
    cc -Wall -Wextra -Werror "$root/examples/c/$example.c" $(pkg-config --cflags --libs terrainwave) \
        -Wl,-rpath,"$libraries" -o "$prefix/$example"
done
# A program that was built with the header of the last promise runs with this library.
# shellcheck disable=SC2046
cc -Wall -Wextra -Werror -I"$root/native/tests/abi" "$root/examples/c/points.c" $(pkg-config --cflags --libs terrainwave) \
    -Wl,-rpath,"$libraries" -o "$prefix/promised"
cmake -S "$root/examples/c" -B "$prefix/cmake" -DCMAKE_PREFIX_PATH="$prefix" >/dev/null
cmake --build "$prefix/cmake" >/dev/null
"$prefix/window" "$file" 10 20 3 4 >"$prefix/by-pkg-config"
"$prefix/cmake/window" "$file" 10 20 3 4 >"$prefix/by-cmake"
"$prefix/bin/twz" check "$file" 2>/dev/null
cmp "$prefix/by-pkg-config" "$prefix/by-cmake"
[ "$(wc -w <"$prefix/by-cmake")" = 12 ]
# Two samples of the window, and a place far away. Samples are 30 m apart, the first corner is at 400000, 4000000.
for program in points cmake/points promised; do
    "$prefix/$program" "$file" 400615 3999685 400705 3999625 0 0 >"$prefix/heights"
    [ "$(paste -sd ' ' "$prefix/heights")" = "$(awk 'NR == 1 {first = $1} NR == 3 {print first, $4, "-"}' "$prefix/by-cmake")" ]
done
echo "$kind: examples/c is built with what is installed, and reads a window and points"
