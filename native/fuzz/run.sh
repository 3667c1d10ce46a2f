#!/bin/sh
# Fuzz files and units for SECONDS_EACH, in the folder of a build with -DTWZ_FUZZ=ON that has seeds/files.txt.
# Inputs that something was found with are left there as found-*; status 1 then. RUNS instead of
# SECONDS_EACH: so many inputs of units.
set -eu
cd "$1"
mkdir -p corpus/files corpus/units
cp seeds/*.twz corpus/files/
options="-entropic=0 -timeout=60 -rss_limit_mb=2048 -artifact_prefix=found- -print_final_stats=1"
export TWZ_FUZZ_FILES=seeds/files.txt
export TWZ_FUZZ_SEEDS=corpus/units
for target in units files; do
    if [ $target = units ]; then
        program=fuzz_unit limits="-max_len=800"
    else
        program=fuzz_file limits="-max_len=4000"
    fi
    limits="$limits ${RUNS:+-runs=$RUNS} ${SECONDS_EACH:+-max_total_time=$SECONDS_EACH}"
    # shellcheck disable=SC2086
    ./$program $options $limits corpus/$target >$target.log 2>&1 || {
        grep -v '^#' $target.log | tail -60
        exit 1
    }
    grep -E "^Done" $target.log | sed "s/^/$target: /"
done
