#!/bin/sh
# What pictures without a screen need, a screen without a screen for the test of the window, and a
# browser for the tests of pages: EGL, OpenGL with Mesa's software driver, Xvfb, xdotool, Chromium
# with its driver, npm; with the argument `qgis` also QGIS without its window, and its Python, for the
# tests of the plugin, and what builds and tests GDAL's driver; with the argument `native` instead of
# all these what builds and tests the native library, and that driver: cmake, gcc, clang with its
# sanitizers and libFuzzer, clang 14 with lld for WebAssembly, GDAL; with `arm` what builds the library for ARM of 64 and 32 bits, and
# runs it: Debian's cross compilers and qemu; with `firefox` Debian's Firefox; with `nginx` or `caddy` that server, unpacked into build/ only: an
# installed one would start and listen. Installed where this is Debian or Ubuntu and apt-get may run;
# elsewhere one line says what is missing, and the tests that need it fail.
set -eu

packages="libegl1 libgl1 libgl1-mesa-dri libglu1-mesa xvfb xauth xdotool chromium chromium-driver"
command -v npm >/dev/null || packages="$packages npm"
wants_qgis=
# What builds GDAL's driver, and the system's own GDAL, its commands and Pythons, which use it.
gdal="cmake make clang g++ libgdal-dev gdal-bin python3-gdal python3-rasterio"
needs="tests that draw need OpenGL and a browser"
elsewhere="EGL, OpenGL 3.3 (Mesa), Xvfb, xdotool, Chromium, npm"
case "${1:-}" in
qgis)
    wants_qgis=1
    packages="$packages python3-qgis $gdal"
    ;;
native)
    packages="cmake make gcc libc6-dev pkg-config clang libclang-rt-dev llvm clang-14 lld-14 $gdal"
    needs="the native library needs compilers, its driver GDAL"
    elsewhere="cmake, make, gcc, pkg-config, clang with sanitizers and libFuzzer, clang 14 and lld 14, GDAL with its headers and Python"
    ;;
arm)
    packages="cmake make qemu-user gcc-aarch64-linux-gnu libc6-dev-arm64-cross gcc-arm-linux-gnueabihf libc6-dev-armhf-cross"
    needs="the native library for ARM needs cross compilers and an emulator"
    elsewhere="cmake, make, gcc and C libraries for aarch64-linux-gnu and arm-linux-gnueabihf, qemu-user"
    ;;
firefox)
    packages="firefox-esr"
    needs="a test of pages needs Firefox"
    elsewhere="firefox-esr"
    ;;
nginx | caddy)
    packages="$1"
    needs="tests of web hosts and proxies need $1"
    elsewhere="$1"
    ;;
esac

has_library() {
    { ldconfig -p 2>/dev/null || /sbin/ldconfig -p 2>/dev/null || true; } | grep -q "$1"
}

has_driver() {
    for file in /usr/lib/*/dri/swrast_dri.so /usr/lib*/dri/swrast_dri.so \
        /usr/lib/*/libgallium-*.so; do
        [ -e "$file" ] && return 0
    done
    return 1
}

is_complete() {
    has_library libEGL.so.1 && has_library libGL.so.1 && has_library libGLU.so.1 && has_driver &&
        command -v xvfb-run >/dev/null && command -v xauth >/dev/null &&
        command -v xdotool >/dev/null && command -v chromium >/dev/null &&
        command -v chromedriver >/dev/null && command -v npm >/dev/null &&
        { [ -z "$wants_qgis" ] || {
            [ -e /usr/lib/python3/dist-packages/qgis/core ] && has_gdal; }; }
}

has_compilers() {
    command -v cmake >/dev/null && command -v make >/dev/null && command -v gcc >/dev/null &&
        command -v pkg-config >/dev/null && command -v clang >/dev/null && command -v clang-14 >/dev/null && command -v wasm-ld-14 >/dev/null &&
        command -v llvm-symbolizer >/dev/null &&
        ls "$(clang -print-resource-dir)"/lib/*/libclang_rt.fuzzer*.a >/dev/null 2>&1
}

has_gdal() {
    command -v cmake >/dev/null && command -v gdal-config >/dev/null && command -v gdalinfo >/dev/null &&
        command -v clang++ >/dev/null && command -v g++ >/dev/null &&
        [ -e /usr/lib/python3/dist-packages/osgeo ] && [ -e /usr/lib/python3/dist-packages/rasterio ]
}

has_arm() {
    command -v cmake >/dev/null && command -v make >/dev/null &&
        for machine in aarch64-linux-gnu:aarch64 arm-linux-gnueabihf:arm; do
            command -v "${machine%:*}-gcc" >/dev/null && command -v "qemu-${machine#*:}" >/dev/null &&
                [ -e "/usr/${machine%:*}/lib/libc.so" ] || return 1
        done
}

[ "$(uname -s)" = Linux ] || exit 0
case "${1:-}" in
native) has_compilers && has_gdal && exit 0 ;;
arm) has_arm && exit 0 ;;
firefox) command -v firefox-esr >/dev/null && exit 0 ;;
nginx) [ -x /usr/sbin/nginx ] || [ -x build/nginx/usr/sbin/nginx ] && exit 0 ;;
caddy) [ -x /usr/bin/caddy ] || [ -x build/caddy/usr/bin/caddy ] && exit 0 ;;
*) is_complete && exit 0 ;;
esac

if [ "$(id -u)" -eq 0 ]; then
    as_root=
elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    as_root="sudo -n"
else
    echo "terrainwave: $needs; run: sudo apt-get install $packages" >&2
    exit 0
fi
if ! command -v apt-get >/dev/null; then
    echo "terrainwave: $needs: $elsewhere" >&2
    exit 0
fi
echo "terrainwave: installing $packages"
case "$packages" in
nginx | caddy)
    files="$packages"
    [ "$packages" = nginx ] && files="nginx nginx-common"
    mkdir -p "build/$packages"
    { $as_root apt-get update -qq && cd "build/$packages" && apt-get download -qq $files &&
        for package in *.deb; do dpkg -x "$package" .; done; } >/dev/null 2>&1 ||
        echo "terrainwave: apt-get could not download $packages" >&2
    exit 0
    ;;
esac
{ $as_root apt-get update -qq &&
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        $packages; } >/dev/null 2>&1 ||
    echo "terrainwave: apt-get could not install $packages" >&2
