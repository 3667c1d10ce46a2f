#!/bin/sh
# Run a command beside the GDAL of another release of Debian: sh tools/other_gdal.sh RELEASE COMMAND ...
# The release is unpacked once into build/gdal/RELEASE (1.5 GB), from where this system gets its packages;
# TERRAINWAVE_GDAL_ROOT names the folder to the command. Needs root, for chroot. Elsewhere one line says so.
set -eu

release=$1
shift
packages="make cmake clang binutils libgdal-dev gdal-bin python3-gdal python3-rasterio"
root=$PWD/build/gdal/$release

. /etc/os-release 2>/dev/null || true
if [ "${VERSION_CODENAME:-}" = "$release" ]; then
    echo "terrainwave: $release is this system, whose GDAL \`make test-all\` tests"
    exit 0
fi
if [ "$(id -u)" -ne 0 ] || ! command -v apt-get >/dev/null; then
    echo "terrainwave: GDAL of $release is not tested: that needs root, on Debian" >&2
    exit 0
fi
if ! [ -e "$root/.complete" ]; then
    echo "terrainwave: unpacking Debian's $release with its GDAL into build/gdal/$release"
    command -v mmdebstrap >/dev/null || { apt-get update -qq && apt-get install -y -qq --no-install-recommends mmdebstrap; } >/dev/null 2>&1
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Component: main' | head -1)
    rm -rf "$root"
    mkdir -p "$root"
    # Releases that change each day are signed for a week: a mirror may be older.
    mmdebstrap --quiet --variant=apt --include="$(echo "$packages" | tr ' ' ,)" \
        --aptopt='APT::Install-Recommends "false"' --aptopt='Acquire::Check-Valid-Until "false"' \
        "$release" "$root" "$mirror"
    touch "$root/.complete"
fi
# This folder and temporary files are at the same place inside; they vanish there when the command ends.
TERRAINWAVE_GDAL_ROOT=$root exec unshare --mount sh -eu -c '
    for folder in "$PWD" "${TMPDIR:-/tmp}" /proc /dev; do
        mkdir -p "$TERRAINWAVE_GDAL_ROOT$folder"
        mount --bind "$folder" "$TERRAINWAVE_GDAL_ROOT$folder"
    done
    "$@"' sh "$@"
