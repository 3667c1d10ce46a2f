# make demo | make test | make test-all | make docs | make qgis | make conformance | make bench | make long
# make native | make native-fuzz | make fuzz | make release-check | make clean
# All targets set up their own virtual environment in .venv; see CONTRIBUTING.md.

PYTHON ?= python3
VENV ?= .venv
WORKERS ?= 2
DATA ?=
SECONDS ?= 60
SIZE ?= 1280x720
FILES ?= 100
PREFIX ?= $(CURDIR)/build/native/prefix
RELEASES ?= bookworm trixie sid

BIN := $(VENV)/bin
# Absolute: tests change their directory.
PYTEST := $(BIN)/python -m pytest -n $(WORKERS)
# A file stays with one worker: what it compiles, the other one loads.
COMPILED := $(PYTEST) --dist loadfile --no-loadscope-reorder

# Tests start many interpreters: each would parse the package anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo qgis conformance test test-all system system-full system-native system-arm system-nginx system-caddy system-firefox native native-arm native-aarch64 native-arm32 native-gcc native-clang native-installed native-agrees native-verdicts native-compared native-sanitized native-fuzz native-driver native-gdal native-gdals native-deb capsule-check amalgamation lint test-compiled test-full test-bounds test-python coverage docs bench long fuzz release-check clean

help:
	@echo "make demo            compress a real terrain, check and draw it, into demo/"
	@echo "make test            what to run before a commit: format, lint, types, the tests, compiled"
	@echo "make test-all        what CI runs besides: long tests, browsers, clusters, notebooks, and"
	@echo "                     the kernels with bounds checked and as plain Python"
	@echo "make coverage        the tests as plain Python, with the lines they miss"
	@echo "make bench DATA=DIR  compare with other codecs on the rasters in DIR: what is not measured yet;"
	@echo "                     AGAIN='predictive speeds' anew, ONLY='cdf97' that alone"
	@echo "make long DATA=DIR   pictures of the rasters in DIR in all modes, measured: is each within its caption?"
	@echo "                     SIZE=1280x720; then 2,000 interruptions of commands; hours; goes on where it stopped"
	@echo "make fuzz SECONDS=60 fuzz each target that long, ONLY='rapid opening' these alone: docs/reliability.md"
	@echo "make native          the native library, its command \`twz\` and GDAL's driver, built and tested with gcc"
	@echo "                     and clang, installed to PREFIX (build/native/prefix)"
	@echo "make native-arm      the same library for ARM of 64 and 32 bits, tested by an emulator: five minutes"
	@echo "make native-gdals    the driver with GDAL of other releases of Debian, RELEASES='trixie sid'; as root"
	@echo "make native-deb      the driver as a .deb for this system's GDAL, into dist/"
	@echo "make native-compared FILES=100  files of any kind, read by the native library and the package"
	@echo "make native-verdicts  twz check and terrainwave verify, of the conformance set and 1,000 mutants"
	@echo "make native-fuzz SECONDS=60  fuzz its files and its units, each half that long"
	@echo "make docs            the site, as build/site; any warning is an error"
	@echo "make release-check   sdist and wheels into dist/, built twice, installed without and with each extra"
	@echo "make qgis            the plugin for QGIS, as dist/terrainwave_plugin.zip"
	@echo "make capsule-check   read capsules (docs/archiving.md) where nothing is but a C compiler, CAPSULES='FILE.twz ...'"
	@echo "make amalgamation    the native library in one source and a header, into build/amalgamation"
	@echo "make conformance     the set for other readers of .twz, as dist/terrainwave-conformance-1.0.zip"
	@echo "make clean           remove what these made"

# --- environments: one stamp per set of extras, renewed when pyproject.toml changes ---

$(VENV)/.created: tools/make_venv.sh
	@sh tools/make_venv.sh "$(PYTHON)" "$(VENV)"
	@touch $@

# What the native library beside the package is built of (src/terrainwave/native_sources.py).
LIBRARY := $(wildcard native/CMakeLists.txt native/include/* native/python/*.* native/src/* src/terrainwave/annexes/*.*)
# Packages are installed again where pyproject.toml has changed; else the library is built again.
install = $(BIN)/python -m pip install --quiet --disable-pip-version-check \
	$(if $(filter $(VENV)/.created pyproject.toml,$?),,--no-deps) --editable

$(VENV)/.installed: $(VENV)/.created pyproject.toml $(LIBRARY)
	$(install) .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.created pyproject.toml $(LIBRARY)
	$(install) ".[dev]"
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-bench: $(VENV)/.created pyproject.toml $(LIBRARY)
	$(install) ".[bench]"
	@touch $@

# --- what people run ---

$(VENV)/.installed-demo: $(VENV)/.created pyproject.toml $(LIBRARY)
	$(install) ".[demo]"
	@touch $@

demo: $(VENV)/.installed-demo
	$(BIN)/terrainwave demo demo

# Nothing but Python's own library is needed.
qgis:
	@$(PYTHON) tools/make_qgis_zip.py dist/terrainwave_plugin.zip

conformance: $(VENV)/.installed
	@$(BIN)/python tools/make_conformance.py dist/terrainwave-conformance-1.0.zip

# A file with its format and a reader in C, read in a folder with nothing but a compiler.
CAPSULES := tests/golden/v2/rapid-digests-float32.twz
capsule-check: $(VENV)/.installed
	@$(BIN)/python tools/check_capsule.py $(CAPSULES)

# The native library in one source and a header, for programs that compile it as their own.
amalgamation: $(VENV)/.installed
	@$(BIN)/python -m terrainwave.capsule build/amalgamation

# What tests of pictures and pages need; nothing happens where all of it is there.
system:
	@sh tools/install_system.sh

# And QGIS's library with its Python.
system-full:
	@sh tools/install_system.sh qgis

system-native:
	@sh tools/install_system.sh native

# Servers that tests of web hosts and proxies start.
system-nginx system-caddy: system-%:
	@sh tools/install_system.sh $*

# A second browser for the page of the site.
system-firefox:
	@sh tools/install_system.sh firefox

system-arm:
	@sh tools/install_system.sh arm

# The lock file would name a registry: versions are exact in package.json instead. deck.gl's peers
# (maps of others, React) take 370 MB and are not used.
tests/ext/node_modules/.installed: tests/ext/package.json
	@sh tools/install_system.sh
	npm install --prefix tests/ext --legacy-peer-deps --no-package-lock --no-audit --no-fund --loglevel error
	@touch $@

# Side by side: the checks of lint take a fraction of the tests' time.
test:
	@$(MAKE) --no-print-directory -j2 lint test-compiled

# What `make test` leaves out. The last four need one core each, and what is BUILT before.
test-all: test-full test-bounds test-python native native-sanitized
	@$(MAKE) --no-print-directory -j$(WORKERS) BUILT=1 native-agrees native-verdicts native-compared native-fuzz capsule-check

lint: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

# Numba's cache does not notice edits in a callee's file: these sources have one of their own, empty
# at first; $(1) tells apart what is compiled otherwise.
with_cache = digest=$$(find src tests -name '*.py' -type f -exec sha256sum {} + | sort | sha256sum | \
	cut -c 1-16) && mkdir -p .numba/$$digest && \
	find .numba -mindepth 1 -maxdepth 1 ! -name "$$digest" -exec rm -rf {} + && \
	NUMBA_CACHE_DIR="$(CURDIR)/.numba/$$digest/$(1)"

test-compiled: $(VENV)/.installed-dev system
	@$(call with_cache,compiled) $(COMPILED) -m "not (full or slow_compile)"

test-full: $(VENV)/.installed-dev system-full system-native system-nginx system-caddy system-firefox tests/ext/node_modules/.installed
	@$(call with_cache,compiled) $(COMPILED) -m "(not kernels or files) and (full or slow_compile or hypothesis)" --hypothesis-profile=full

# What plain Python runs, too, has its indices checked there. Less optimised: compiled in three
# quarters of the time, and the bounds are the same.
test-bounds: $(VENV)/.installed-dev system
	@$(call with_cache,bounds) NUMBA_BOUNDSCHECK=1 NUMBA_OPT=1 $(COMPILED) -m "kernels and not files and (large or full or slow_compile or hypothesis)" --hypothesis-profile=full

test-python: $(VENV)/.installed-dev
	NUMBA_DISABLE_JIT=1 $(PYTEST) --dist worksteal -m "kernels and not (large or full)"

coverage: $(VENV)/.installed-dev
	$(BIN)/coverage erase
	NUMBA_DISABLE_JIT=1 $(BIN)/coverage run -m pytest -n $(WORKERS) -m "not (large or full)"
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report

# Outside CI. Exits with 1 if a file in C has other bytes, a caption says less than is measured, or an interruption finds a fault.
long: $(VENV)/.installed-bench $(VENV)/.installed-dev system
	@test -n "$(DATA)" || { echo "make long DATA=a-directory-with-GeoTIFFs" >&2; exit 2; }
	@$(MAKE) --no-print-directory native-gdals
	@$(MAKE) --no-print-directory native-fuzz RUNS=10000000
	TERRAINWAVE_NATIVE=1 $(BIN)/python -m benchmarks.both_encoders
	$(BIN)/python -m benchmarks.captions "$(DATA)" --size $(SIZE)
	$(BIN)/python tools/check_capsule.py "$(DATA)"/*.tif
	$(BIN)/python -m benchmarks.altered
	$(BIN)/python -m benchmarks.one_sided
	$(BIN)/python -m faults.run --only signals --signals 223

bench: $(VENV)/.installed-bench
	@test -n "$(DATA)" || { echo "make bench DATA=a-directory-with-GeoTIFFs" >&2; exit 2; }
	$(BIN)/python -m benchmarks.bench "$(DATA)" $(if $(ONLY),--only $(ONLY)) $(if $(AGAIN),--again $(AGAIN))

$(VENV)/.installed-fuzz: $(VENV)/.created pyproject.toml $(LIBRARY)
	$(install) ".[fuzz]"
	@touch $@

# Bounds are checked here: kernels have a cache of their own.
fuzz: $(VENV)/.installed-fuzz
	NUMBA_CACHE_DIR="$(CURDIR)/build/fuzz/numba" $(BIN)/python -m fuzz.run --seconds $(SECONDS) $(ONLY)

# --- the native library ---

# Build in build/native/$(1) with the compiler $(2) and options of CMake $(3), and run its tests.
built_natively = cmake -S native -B build/native/$(1) -DCMAKE_C_COMPILER=$(2) -DTWZ_WARNINGS_ARE_ERRORS=ON $(3) >/dev/null && \
	cmake --build build/native/$(1) -j $(WORKERS) -- -s --no-print-directory
tested_natively = ctest --test-dir build/native/$(1) --output-on-failure -j $(WORKERS)

# The driver is made where clang has built.
native: native-gcc native-clang native-installed
	@$(MAKE) --no-print-directory native-driver

# clang's build has the driver, too.
with_driver = -DTWZ_GDAL=ON -DCMAKE_CXX_COMPILER=clang++

native-gcc native-clang: native-%: system-native
	@$(call built_natively,$*,$*,$(if $(filter clang,$*),$(with_driver))) && $(call tested_natively,$*)

# What is installed is enough to build examples/c with: a static library, and a shared one.
native-installed: native-gcc
	@$(call built_natively,shared,gcc,-DBUILD_SHARED_LIBS=ON)
	@sh native/tests/installed.sh build/native/gcc build/native/installed-static static
	@sh native/tests/installed.sh build/native/shared build/native/installed-shared shared

# ARM of 64 and of 32 bits. No part of test-all: emulators take their time.
native-arm: native-aarch64 native-arm32

native-aarch64: system-arm
	@$(call built_natively,aarch64,aarch64-linux-gnu-gcc,-DCMAKE_TOOLCHAIN_FILE=cmake/aarch64.cmake) && $(call tested_natively,aarch64)

native-arm32: system-arm
	@$(call built_natively,arm32,arm-linux-gnueabihf-gcc,-DCMAKE_TOOLCHAIN_FILE=cmake/arm.cmake) && $(call tested_natively,arm32)

# By clang, whose kernels are faster. The tests are those of tests/gdal_driver.
native-driver: system-native
	@$(call built_natively,clang,clang,$(with_driver))
	@cmake --install build/native/clang --prefix "$(PREFIX)" >/dev/null
	@folder=$$(dirname $$(find "$(PREFIX)" -name gdal_TWZ.so | head -1)) && \
		GDAL_DRIVER_PATH=$$folder gdalinfo tests/golden/v2/one-sample.twz >/dev/null && \
		echo "GDAL reads .twz files where GDAL_DRIVER_PATH is $$folder"

# The tests of the driver, with GDAL of this system and of other releases of Debian: 3.6, 3.10, and the newest there is.
driver_tests := tests/gdal_driver/test_driver.py tests/gdal_driver/test_commands.py

native-gdal: $(VENV)/.installed-dev system-native
	@$(call with_cache,compiled) $(COMPILED) $(driver_tests)

native-gdals: $(VENV)/.installed-dev system-native
	@for release in $(RELEASES); do \
		$(call with_cache,compiled) sh tools/other_gdal.sh $$release $(COMPILED) $(driver_tests) || exit 1; done

# One for each minor version of GDAL: that of this system.
native-deb: system-native
	@$(call built_natively,deb,clang,$(with_driver) -DBUILD_TESTING=OFF -DCMAKE_INSTALL_PREFIX=/usr)
	@mkdir -p dist && cd build/native/deb && \
		SOURCE_DATE_EPOCH=$${SOURCE_DATE_EPOCH:-$$(git log -1 --format=%ct 2>/dev/null || echo 0)} cpack -G DEB >/dev/null && cp *.deb "$(CURDIR)/dist/" && \
		echo "dist/$$(ls -t *.deb | head -1)"

# What the package writes and reads by numba, read by C as well: the package has the library, too.
by_numba = $(call with_cache,compiled) TERRAINWAVE_NATIVE=0 $(BIN)/python

native-agrees: $(if $(BUILT),,native-gcc) $(VENV)/.installed-dev
	@$(by_numba) native/tests/against_python.py build/native/gcc/twz

# twz check and terrainwave verify, of the conformance set and of mutants of it.
native-verdicts: $(if $(BUILT),,native-sanitized) $(VENV)/.installed-dev
	@$(by_numba) native/fuzz/verdicts.py build/native/sanitized

native-sanitized: system-native
	@$(call built_natively,sanitized,clang,-DTWZ_SANITIZE=ON) && $(call tested_natively,sanitized)

native-compared: $(if $(BUILT),,native-sanitized) $(VENV)/.installed-dev
	@$(by_numba) native/fuzz/compare.py build/native/sanitized/twz $(FILES)

# Small sound files of each method, made by the package that is tested here; what fuzzers find
# new stays in build/native/fuzz/corpus.
build/native/fuzz/seeds/files.txt: native/fuzz/seeds.py native/fuzz/forced.py | $(VENV)/.installed-dev
	@$(call with_cache,compiled) $(BIN)/python native/fuzz/seeds.py "$(CURDIR)/build/native/fuzz/seeds"

native-fuzz: system-native build/native/fuzz/seeds/files.txt
	@$(call built_natively,fuzz,clang,-DTWZ_SANITIZE=ON -DTWZ_FUZZ=ON)
	@$(if $(RUNS),RUNS=$(RUNS),SECONDS_EACH=$$(($(SECONDS) / 2))) sh native/fuzz/run.sh build/native/fuzz

docs: $(VENV)/.installed-dev
	$(BIN)/mkdocs build --strict

$(VENV)/.installed-release: $(VENV)/.created pyproject.toml $(LIBRARY)
	$(install) ".[release]"
	@touch $@

release-check: $(VENV)/.installed-release system
	$(BIN)/python -m tools.release_check

clean:
	rm -rf $(VENV) demo build dist .numba .pytest_cache .hypothesis .mypy_cache .ruff_cache
	rm -f .coverage .coverage.* src/terrainwave/libterrainwave.* src/terrainwave/native.json
	find src tests benchmarks examples -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true
