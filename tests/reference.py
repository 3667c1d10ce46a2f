"""The slow, obvious versions: loops, exact rationals, numpy. Never imported by `src`."""

from fractions import Fraction

import numpy as np

from terrainwave.grid.quadtree import Region

# CDF 9/7 analysis low-pass, DC gain 1, centre first: Cohen, Daubechies, Feauveau 1992, table 6.2
# (there times sqrt 2), as printed in JPEG 2000 part 1, table F.2.
CDF97_LOWPASS = (
    0.6029490182363579,
    0.2668641184428723,
    -0.07822326652898785,
    -0.01686411844287495,
    0.02674875741080976,
)


def surface_at(heights, stride, row, col):
    """Return the bilinear surface of a block at a full-grid place, exactly.

    A sample past the last row or column lies on the line through the last two.
    """
    return _between(
        lambda r: _between(lambda c: Fraction(int(heights[r, c])), heights.shape[1], stride, col),
        heights.shape[0],
        stride,
        row,
    )


def _between(value, n, stride, place):
    def at(index):
        if index < n:
            return value(index)
        return value(0) if n == 1 else 2 * value(n - 1) - value(n - 2)

    cell, part = divmod(place, stride)
    if part == 0:
        return at(cell)
    return (at(cell) * (stride - part) + at(cell + 1) * part) / stride


def bilinear_error(heights, stride, originals, valid, row=0, col=0):
    """Return the largest distance of valid originals from a block's bilinear surface, exactly.

    `originals` begin at full-grid place (row, col) of the block, whose first sample is (0, 0).
    """
    errors = [
        abs(surface_at(heights, stride, row + r, col + c) - int(originals[r, c]))
        for r, c in np.argwhere(valid).tolist()
    ]
    return max(errors, default=Fraction(0))


def recursive_errors(levels, side, bound):
    """Return Err_Appr of every block: Yusov & Turlapov 2010, equation (2), by block (row, column).

    On the finest level `bound`; above it the largest of a block's children, the largest distance of
    their decoded samples from the block's bilinear surface, and `bound`.

    Parameters
    ----------
    levels : list of ndarray
        Decoded heights of all levels, the coarsest first, without voids. Sizes are multiples of
        `side`, the cells of a block, and one more sample.
    """
    n_rows, n_cols = ((n - 1) // side for n in levels[-1].shape)
    found = [{(row, col): Fraction(bound) for row in range(n_rows) for col in range(n_cols)}]
    for coarse, fine in zip(levels[-2::-1], levels[:0:-1], strict=True):
        errors = {}
        for row in range(-(-(coarse.shape[0] - 1) // side)):
            for col in range(-(-(coarse.shape[1] - 1) // side)):
                own = coarse[row * side :, col * side :][: side + 1, : side + 1]
                below = fine[2 * row * side :, 2 * col * side :][: 2 * side + 1, : 2 * side + 1]
                apart = bilinear_error(own, 2, below, np.ones(below.shape, dtype=bool))
                children = max(
                    error for (r, c), error in found[0].items() if (r // 2, c // 2) == (row, col)
                )
                errors[row, col] = children + apart + bound
        found.insert(0, errors)
    return found


def outer_region(corner, shape, aprons):
    """Return a region of the level above one, with room for aprons of 0 or 1 on each side."""
    return Region(
        max((corner[0] >> 1) - aprons[0], 0), max((corner[1] >> 1) - aprons[1], 0),
        (shape[0] >> 1) + 2 + aprons[2], (shape[1] >> 1) + 2 + aprons[3],
    )  # fmt: skip


def implied_voids(region, outer, valid):
    """Return which samples of a region are void, as samples above that touch them are (§5.1)."""

    def touched(first, n, outer_first, outer_n):
        places = np.arange(first, first + n)
        return [np.clip(places + after - 2 * outer_first >> 1, 0, outer_n - 1) for after in (0, 1)]

    found = np.zeros(region.shape, dtype=bool)
    for rows in touched(region.row, region.n_rows, outer.row, outer.n_rows):
        for cols in touched(region.col, region.n_cols, outer.col, outer.n_cols):
            found |= ~valid[np.ix_(rows, cols)]
    return found


def level_mask(valid, shift):
    """Return the mask of the level `shift` steps above the full grid.

    A coarse sample is valid iff any full-grid sample of the cells touching it is.
    """
    if shift == 0:
        return valid.copy()
    stride = 1 << shift
    shape = level_shape(valid.shape, shift)
    mask = np.zeros(shape, dtype=bool)
    for row in range(shape[0]):
        for col in range(shape[1]):
            rows = slice(max((row - 1) * stride, 0), (row + 1) * stride + 1)
            cols = slice(max((col - 1) * stride, 0), (col + 1) * stride + 1)
            mask[row, col] = valid[rows, cols].any()
    return mask


def level_shape(shape, shift):
    """Return how many samples a level has inside the raster: every 2**shift-th one."""
    return len(range(0, shape[0], 1 << shift)), len(range(0, shape[1], 1 << shift))


def push_pull(quanta, valid):
    """Return `quanta` with voids filled: weighted means upward, bilinear interpolation downward.

    Push: weights 1 2 1 in each direction, the edge repeated, rounded down. Pull: the mean of the
    four (or two, or one) coarse samples around, rounded half up.
    """
    n_rows, n_cols = quanta.shape
    if (n_rows, n_cols) == (1, 1):
        return np.where(valid, quanta, 0)
    coarse_shape = level_shape(quanta.shape, 1)
    coarse = np.zeros(coarse_shape, dtype=object)
    known = np.zeros(coarse_shape, dtype=bool)
    for row in range(coarse_shape[0]):
        for col in range(coarse_shape[1]):
            total = weights = 0
            for down in (-1, 0, 1):
                for across in (-1, 0, 1):
                    r = min(max(2 * row + down, 0), n_rows - 1)
                    c = min(max(2 * col + across, 0), n_cols - 1)
                    if valid[r, c]:
                        weight = (2 - abs(down)) * (2 - abs(across))
                        total += weight * int(quanta[r, c])
                        weights += weight
            if weights:
                coarse[row, col], known[row, col] = total // weights, True
    filled = push_pull(coarse, known)
    result = np.array(quanta, dtype=object)
    for row, col in np.argwhere(~valid).tolist():
        r0, c0 = row // 2, col // 2
        r1, c1 = min((row + 1) // 2, coarse_shape[0] - 1), min((col + 1) // 2, coarse_shape[1] - 1)
        total = filled[r0, c0] + filled[r0, c1] + filled[r1, c0] + filled[r1, c1]
        result[row, col] = (total + 2) // 4
    return result


def lowpass_taps():
    """Return the nine taps in 1/2**14: rounded, the centre such that they sum to 2**14."""
    side = [round(tap * 2**14) for tap in CDF97_LOWPASS[1:]]
    return [*side[::-1], 2**14 - 2 * sum(side), *side]


def lowpass(heights):
    """Return the next coarser level by convolution with mirrored padding, rounded half up."""
    total = _filter(heights.astype(object), lowpass_taps())
    return np.array([[(v + 2**27) // 2**28 for v in line] for line in total]).astype(np.int64)


def lowpass_unrounded(heights):
    """Return the next coarser level with the printed taps in float64."""
    taps = [*CDF97_LOWPASS[:0:-1], *CDF97_LOWPASS]
    return _filter(heights.astype(np.float64), taps)


def _filter(heights, taps):
    for axis in (0, 1):
        width = [(4, 4) if a == axis else (0, 0) for a in (0, 1)]
        padded = np.pad(heights, width, mode="reflect")
        n = heights.shape[axis]
        heights = sum(
            tap * np.take(padded, range(k, k + n, 2), axis=axis) for k, tap in enumerate(taps)
        )
    return heights
