#!/bin/sh
# Make a virtual environment: make_venv.sh PYTHON DIRECTORY
# On failure: one line that says what to do.
set -eu

python=$1
venv=$2

fail() {
    echo "terrainwave: $1" >&2
    exit 1
}

is_new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

# Debian and Ubuntu ship venv's `ensurepip` apart from Python.
has_venv() {
    "$1" -c 'import ensurepip, venv' 2>/dev/null
}

install_venv() {
    package=$("$1" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
    if [ "$(id -u)" -ne 0 ] || ! command -v apt-get >/dev/null; then
        fail "Python's venv module is missing; run: sudo apt-get install $package"
    fi
    echo "terrainwave: installing $package"
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$package"; } \
        >/dev/null 2>&1 || fail "apt-get could not install $package; see: apt-get install $package"
}

if ! is_new_enough "$python"; then
    found=
    for name in python3.14 python3.13 python3.12 python3.11; do
        if is_new_enough "$name"; then found=$name; break; fi
    done
    [ -n "$found" ] || fail "Python 3.11 or newer is needed ('$python' is not); say which: make PYTHON=python3.12 ..."
    python=$found
fi

has_venv "$python" || install_venv "$python"
has_venv "$python" || fail "'$python' has no venv module; say another: make PYTHON=python3.12 ..."
"$python" -m venv --clear "$venv" || fail "'$python -m venv $venv' failed; the lines above say why"
