#!/bin/sh
# Bundle the libraries of the site's page (js/site) from npm, each as one module with the licences of its parts.
# Needs npm. ESBUILD names another esbuild than npm's.
set -eu
cd "$(dirname "$0")/../js/site"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
npm install --prefix "$work" --no-package-lock --silent geotiff@3.0.5 @mapbox/martini@0.2.0 esbuild@0.28.2

# bundle NAME VERSION LICENCE EXPORTS PACKAGE…
bundle() {
    name=$1 version=$2 licence=$3 exports=$4
    shift 4
    mkdir -p "$name"
    echo "export $exports from \"$1\";" >"$work/$name.js"
    "${ESBUILD:-$work/node_modules/.bin/esbuild}" "$work/$name.js" --bundle --format=esm --minify --platform=browser \
        --target=es2022 --legal-comments=none --outfile="$name/$name.js" --log-level=warning \
        --banner:js="/* $1 $version, $licence; LICENSE.txt has the licences of all parts. Made by tools/bundle_site.sh. */"
    for package; do
        echo "$package: $(sed -n 's/^[[:space:]]*"license": "\(.*\)",*$/\1/p' "$work/node_modules/$package/package.json" | head -1)"
        echo
        cat "$work/node_modules/$package"/[Ll][Ii][Cc][Ee][Nn][CcSs][Ee]* 2>/dev/null || echo "(the package has no text of it)"
        echo
    done >"$name/LICENSE.txt"
}
bundle geotiff 3.0.5 MIT "{ fromBlob, fromArrayBuffer }" geotiff @petamoriken/float16 lerc pako parse-headers \
    quick-lru web-worker xml-utils zstddec
bundle martini 0.2.0 ISC "{ default }" @mapbox/martini
