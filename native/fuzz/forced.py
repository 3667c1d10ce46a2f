"""Files with what encoders choose rarely: any tables of rapid, any corrections.

Both are what a file may have (docs/format-rapid.md R.10, docs/FORMAT.md §5.5); encoders take tables
that suit a raster, and corrections where a patch needs them.
"""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from terrainwave.codec.rapid import trained as rapid_tables
from terrainwave.codec.rapid.file_tables import (
    FREQ_OF_CODE,
    MAX_CODE,
    N_CLASSES,
    PLANES,
    FileStencil,
    FileTables,
    are_sound,
    core_taps,
    default_codes,
    freqs_of,
    missing_tap,
    pack_file_tables,
    rest_symbols,
    weights_of,
)
from terrainwave.codec.rapid.refiner import RapidRefiner
from terrainwave.codec.refiner import FREE
from terrainwave.container.header import HAS_CORRECTIONS
from terrainwave.errors import CorruptStreamError
from terrainwave.names import METHODS
from terrainwave.write.encoder import TreeEncoder
from terrainwave.write.job import Job

N_FEATURES = len(rapid_tables.FEATURES[0][0][0])
MOST = 2**31 - 1


def any_stencil(rng, plane):
    """Return a stencil of a set of the format, at times changed."""
    base = int(rng.integers(len(rapid_tables.STENCILS[plane])))
    while rng.random() < 0.3:
        deltas = rng.integers(-40, 41, len(core_taps(plane)))
        deltas[missing_tap(plane)] = 0
        stencil = FileStencil(base, int(rng.integers(3)), tuple(deltas.tolist()))
        try:
            weights_of(plane, stencil)
        except CorruptStreamError:
            continue
        return stencil
    return FileStencil(base)


def any_weights(rng):
    """Return codes of weights of one class to all of them, some as large as they may be."""
    shape = int(rng.integers(1, N_CLASSES + 1)), len(PLANES), N_FEATURES
    codes = rng.integers(0, rng.choice([30, 70, MAX_CODE + 1]), shape)
    codes[:, 0, 7:] = 0  # HH has no planes before it
    for which, plane in np.ndindex(codes.shape[:2]):
        alone = np.zeros_like(codes[:1])
        alone[0, plane] = own = codes[which, plane]
        while not are_sound(alone):  # ends close to what is just sound
            feature = rng.integers(1, N_FEATURES)
            own[feature] -= own[feature] > 0
            alone[0, plane] = own
    return codes


def any_codes(rng, family):
    """Return codes of frequencies of some contexts."""
    trained, found = default_codes(family), {}
    for context in np.flatnonzero(rng.random(len(trained)) < rng.random() ** 4):
        codes = np.clip(trained[context] + rng.integers(-3, 4, trained.shape[1]), 1, MAX_CODE)
        rest = rest_symbols(family)[context : context + 1]
        others = np.delete(codes, rest)
        while FREQ_OF_CODE[others].sum() >= FREQ_OF_CODE[MAX_CODE]:
            others[others.argmax()] -= 1
        codes[np.arange(len(codes)) != rest] = others
        codes[rest] = trained[context][rest]
        try:
            freqs_of(codes[None], rest)
        except CorruptStreamError:
            continue
        found[int(context)] = codes
    return found


def any_tables(rng, k_max, has_weights):
    """Return tables of rapid, of any layout."""
    family = int(rng.integers(2 * rapid_tables.N_FAMILIES))
    stencils = tuple(tuple(any_stencil(rng, plane) for plane in PLANES) for _ in range(N_CLASSES))
    k_max = max(k_max + int(rng.integers(-1, 3)), 0)  # which class a level has
    weights = any_weights(rng) if has_weights else None
    return FileTables(k_max, family, stencils, any_codes(rng, family), weights)


def noise(spec, seed):
    """Return a number of each sample of a unit, the same in all units that have it."""
    row, col = np.indices(spec.region.shape, dtype=np.uint64)
    row, col = row + np.uint64(spec.region.row), col + np.uint64(spec.region.col)
    mixed = (row * np.uint64(0x9E3779B97F4A7C15)) ^ (col * np.uint64(0xC2B2AE3D27D4EB4F))
    mixed ^= np.uint64(seed + 1000 * spec.level)
    for _ in range(2):
        mixed = (mixed ^ (mixed >> np.uint64(31))) * np.uint64(0xD6E8FEB86659FD93)
    return mixed >> np.uint64(16)


def any_kept(share, seed):
    """Return what `TreeEncoder.kept` becomes.

    Some heights stay, within the bound; of void samples any do, beyond all limits too.
    """

    def kept(encoder, _key, spec, target, mask):
        if not METHODS[encoder._refiner.name].is_patchable:  # a plain one may be tried, too
            return None
        chosen = noise(spec, seed)
        apart = (noise(spec, seed + 1) % np.uint64(spec.step)).astype(np.int64) - spec.half
        near = np.clip(target + apart, spec.z_min, spec.z_max)
        far = (noise(spec, seed + 2) % np.uint64(2 * MOST + 1)).astype(np.int64) - MOST
        far >>= (noise(spec, seed + 3) % np.uint64(28)).astype(np.int64)
        stays = chosen % np.uint64(1 << 20) < np.uint64(int(share * (1 << 20)))
        return np.where(stays, np.where(mask, near, far), FREE).astype(np.int32)

    return kept


@contextmanager
def tables(rng, *, has_weights):
    """Let rapid have any tables within the `with` block."""
    before = RapidRefiner.fitted

    def fitted(_self, grid, *_rest, **_options):
        return RapidRefiner(pack_file_tables(any_tables(rng, grid.k_max, has_weights)))

    RapidRefiner.fitted = fitted
    try:
        yield
    finally:
        RapidRefiner.fitted = before


@contextmanager
def corrections(share, seed):
    """Let lossy files have corrections of a share of their samples within the `with` block."""
    parameters, header, kept = Job.parameters, Job.header, TreeEncoder.kept
    Job.parameters = property(lambda job: replace(parameters.fget(job), has_corrections=True))

    def marked(job, tables_of_file):
        plain = header(job, tables_of_file)
        if not METHODS[plain.method].is_patchable:
            return plain
        return replace(plain, features=plain.features | HAS_CORRECTIONS)

    Job.header, TreeEncoder.kept = marked, any_kept(share, seed)
    try:
        yield
    finally:
        Job.parameters, Job.header, TreeEncoder.kept = parameters, header, kept
