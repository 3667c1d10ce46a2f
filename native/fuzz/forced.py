"""Files with what encoders choose rarely: any tables of rapid, any corrections.

Both are what a file may have (docs/format-rapid.md R.10, docs/FORMAT.md §5.5); encoders take tables
that suit a raster, and corrections where a patch needs them.
"""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from terrainwave.codec.planes import FileStencil
from terrainwave.codec.rapid.file_tables import (
    EXISTS,
    LEAST,
    MAX_CODE,
    N_CLASSES,
    N_FEATURES,
    N_LEVEL_CLASSES,
    N_SLOTS,
    NUMBER_OF_CODE,
    PLANES,
    RESTS,
    FileTables,
    annex,
    core_taps,
    missing_tap,
    pack_file_tables,
    stencils_from,
)
from terrainwave.codec.rapid.refiner import RapidRefiner
from terrainwave.codec.refiner import FREE
from terrainwave.container.header import HAS_CORRECTIONS
from terrainwave.errors import CorruptStreamError
from terrainwave.names import METHODS
from terrainwave.write.encoder import TreeEncoder
from terrainwave.write.job import Job

MOST = 2**31 - 1


def any_stencil(rng, plane):
    """Return a stencil of a set of the format, at times changed."""
    base = int(rng.integers(annex().stencils.shape[1]))
    if rng.random() < 0.5:
        return FileStencil(base)
    deltas = rng.integers(-40, 41, len(core_taps(plane)))
    deltas[missing_tap(plane)] = 0
    return FileStencil(base, int(rng.integers(3)), tuple(deltas.tolist()))


def any_stencils(rng, plain):
    """Return stencils of all classes and planes, those of sets where others are out of range."""
    rows = tuple(tuple(any_stencil(rng, plane) for plane in PLANES) for _ in range(N_LEVEL_CLASSES))
    try:
        stencils_from(plain._replace(stencils=rows))
    except CorruptStreamError:
        return plain.stencils
    return rows


def any_codes(rng, family):
    """Return codes of frequencies of some tables."""
    found = {}
    for table in np.flatnonzero(EXISTS.any(1) & (rng.random(len(EXISTS)) < rng.random() ** 4)):
        is_told = EXISTS[table] & (np.arange(EXISTS.shape[1]) != RESTS[table])
        codes = annex().codes[family, table] + rng.integers(-3, 4, EXISTS.shape[1])
        codes = np.where(is_told, np.clip(codes, 0, MAX_CODE), annex().codes[family, table])
        while (NUMBER_OF_CODE[codes] + LEAST[table])[is_told].sum() >= N_SLOTS:
            codes[np.where(is_told, codes, 0).argmax()] -= 1
        found[int(table)] = codes
    return found


def any_tables(rng, k_max):
    """Return tables of rapid."""
    family = int(rng.integers(len(annex().cuts)))
    k_max = max(k_max + int(rng.integers(-1, 3)), 0)  # which class a level has
    shape = N_LEVEL_CLASSES, len(PLANES), N_FEATURES
    weights = rng.integers(0, rng.choice([30, 70, MAX_CODE + 1]), shape)
    cut, sets = int(rng.integers(N_CLASSES + 1)), ((FileStencil(0),) * 3,) * N_LEVEL_CLASSES
    plain = FileTables(k_max, family, sets, weights, cut, any_codes(rng, family))
    return plain._replace(
        stencils=any_stencils(rng, plain),
        codes={table: own for table, own in plain.codes.items() if not cut <= table < N_CLASSES},
    )


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
def tables(rng):
    """Let rapid have any tables within the `with` block."""
    before = RapidRefiner.fitted

    def fitted(_self, grid, *_rest, **_options):
        return RapidRefiner(pack_file_tables(any_tables(rng, grid.k_max)))

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
