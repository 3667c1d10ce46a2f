"""Kinds of meshes with stored bytes: the bytes of a block, and the mesh they describe.

`halves` depends only on decoded samples. The border vertices of these kinds depend on the inside of
neighbours (`zerotree.agreement`), so each block's bytes hold what its own samples lack: for
`zerotree` the whole cut, for `rqt` the border vertices outside its own selection.
"""

import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.coding.rangecoder import (
    code_bit,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_models,
)
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import CorruptStreamError
from terrainwave.tri.block_mesh import BlockMesh
from terrainwave.tri.rqt.stored import Selection, rqt_mesh, select_vertices, vertices_of
from terrainwave.tri.zerotree.agreement import BorderVertices, border_of, border_of_cut
from terrainwave.tri.zerotree.connect import mesh_of_cut
from terrainwave.tri.zerotree.guarantee import guaranteed_cut
from terrainwave.tri.zerotree.labels import Trees
from terrainwave.tri.zerotree.refinement import decode_refinement, encode_refinement

# A border line has at most 4097 samples; contexts: spacing, and the number of ends that are
# vertices.
_N_SPACINGS = 13
_N_MODELS = 3 * _N_SPACINGS


class StoredSamples(NamedTuple):
    """Samples of a block, and more for some kinds.

    `locked` are void or next to a void, in the block or beyond its border. `trees` are the zero
    trees of the group that refines the block, `coefficients` the magnitudes of wavelet coefficients
    at its samples, in quanta.
    """

    heights: NDArray[np.int32]
    mask: NDArray[np.bool_]
    locked: NDArray[np.bool_]
    trees: Trees | None
    coefficients: NDArray[np.int64] | None = None


class Draft(NamedTuple):
    """A block's triangulation before its level agrees; `packed` is the kind's own data."""

    border: BorderVertices
    packed: bytes


def _kept(samples: StoredSamples, demanded: BorderVertices | None) -> NDArray[np.bool_]:
    if demanded is None:
        return samples.locked
    return samples.locked | demanded.keep(samples.mask.shape)


class StoredZerotree:
    """Algorithm I; the bytes are its refinement labels (`zerotree.refinement`).

    With zero trees the mesh is nowhere coarser than they are, and labels hold the difference. A
    kind drafts a triangulation with at least the demanded border vertices, encodes the draft in
    agreement with its level, and makes the mesh of these bytes, or one without neighbours.
    """

    def draft(
        self, samples: StoredSamples, tolerance: int, demanded: BorderVertices | None
    ) -> Draft:
        keep = _kept(samples, demanded)
        cut = guaranteed_cut(samples.heights, samples.mask, tolerance, samples.trees, keep)
        return Draft(border_of_cut(cut), zlib.compress(cut.tobytes(), 1))

    def encode(self, samples: StoredSamples, tolerance: int, draft: Draft) -> bytes:
        cut = np.frombuffer(zlib.decompress(draft.packed), dtype=np.uint8)
        cut = cut.reshape(samples.mask.shape)
        return encode_refinement(cut, samples.heights, samples.mask, tolerance, samples.trees)

    def alone(self, samples: StoredSamples, tolerance: int) -> BlockMesh:
        heights, mask, keep = samples.heights, samples.mask, samples.locked
        cut = guaranteed_cut(heights, mask, tolerance, samples.trees, keep)
        return mesh_of_cut(heights, mask, cut)

    def mesh(self, samples: StoredSamples, tolerance: int, data: bytes) -> BlockMesh:
        cut = decode_refinement(data, samples.heights, samples.mask, tolerance, samples.trees)
        return mesh_of_cut(samples.heights, samples.mask, cut)


def _select(samples: StoredSamples, tolerance: int, keep: NDArray[np.bool_]) -> Selection:
    """Return a block's restricted quadtree, by coefficients if there are any."""
    return select_vertices(
        samples.heights, samples.mask, tolerance, keep=keep, coefficients=samples.coefficients
    )


class StoredRqt:
    """The restricted quadtree; the bytes are the border vertices that only neighbours need.

    With coefficients these select vertices, and the tolerance is not a bound.
    """

    def draft(
        self, samples: StoredSamples, tolerance: int, demanded: BorderVertices | None
    ) -> Draft:
        selection = _select(samples, tolerance, _kept(samples, demanded))
        return Draft(border_of(vertices_of(selection, samples.mask.shape)), b"")

    def encode(self, samples: StoredSamples, tolerance: int, draft: Draft) -> bytes:
        """Return the border vertices beyond the block's own; perhaps empty."""
        own = self.draft(samples, tolerance, None).border
        shape = samples.mask.shape
        known, wanted = own.keep(shape), draft.border.keep(shape)
        if np.array_equal(known, wanted):
            return b""
        out = np.empty(4 * sum(shape) + 64, dtype=np.uint8)
        coder = new_encoder(out, new_models(_N_MODELS))
        _code_border(known, wanted, coder)
        return out[: finish_encoder(coder.state, out)].tobytes()

    def alone(self, samples: StoredSamples, tolerance: int) -> BlockMesh:
        return self.mesh(samples, tolerance, b"")

    def mesh(self, samples: StoredSamples, tolerance: int, data: bytes) -> BlockMesh:
        """Return the mesh with the border vertices of the block itself and of `data`."""
        heights, mask = samples.heights, samples.mask
        selection = _select(samples, tolerance, samples.locked)
        if data:
            on_border = border_of(vertices_of(selection, mask.shape)).keep(mask.shape)
            n_own = np.count_nonzero(on_border)
            coder = new_decoder(data, new_models(_N_MODELS))
            _code_border(on_border, None, coder)
            raise_for_status(*finish_decoder(coder.state, coder.stream))
            if np.count_nonzero(on_border) == n_own:
                raise CorruptStreamError("border vertices take bytes, but there are none")
            selection = _select(samples, tolerance, samples.locked | on_border)
        return rqt_mesh(heights, mask, selection)


STORED_KINDS: dict[str, StoredZerotree | StoredRqt] = {
    "zerotree-plain": StoredZerotree(),
    "zerotree-layer": StoredZerotree(),
    "zerotree-coded": StoredZerotree(),
    "rqt": StoredRqt(),
    "rqt-coefficient": StoredRqt(),
}


@kernel
def _code_border(flags, wanted, coder):
    """Encode which border samples are vertices, or decode if `wanted` is None.

    `flags`, shape (n_rows, n_cols), holds the known vertices, and receives all. Lines in the order
    top, left, bottom, right; in each spacings downwards, and samples in order.
    """
    last_row, last_col = flags.shape[0] - 1, flags.shape[1] - 1
    for side in range(4):
        down, right = (0, 1) if side % 2 == 0 else (1, 0)
        row = last_row if side == 2 else 0
        col = last_col if side == 3 else 0
        last = last_col if side % 2 == 0 else last_row
        log = 0
        while 2 << log < last:
            log += 1
        while log >= 0:
            spacing = 1 << log
            for place in range(spacing, last, 2 * spacing):
                i, j = row + place * down, col + place * right
                if flags[i, j]:
                    continue
                after = min(place + spacing, last)
                index = 3 * log
                if flags[row + (place - spacing) * down, col + (place - spacing) * right]:
                    index += 1
                if flags[row + after * down, col + after * right]:
                    index += 1
                if wanted is not None:
                    flags[i, j] = wanted[i, j]
                flags[i, j] = code_bit(coder, index, np.int64(flags[i, j])) == 1
            log -= 1
