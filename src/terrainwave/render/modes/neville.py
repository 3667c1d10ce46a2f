"""Neville filters of order 2 or 4 (Kovačević, Sweldens 2000), weighted as by Zhang et al. 2012.

Theirs compute a sample from the 4 x 4 around it (§1, eq. 1). Here they predict a sample from its
neighbours: on a line from the nearest two by ½, or from four by 9/16 and -1/16; in the middle of
four by ¼ each, or by 10/32 each less 1/32 of the eight next to those (fig. 2). A level is made from
the finer one by their update, a quarter of the transposed filters: half of it on a line. Samples of
levels then nest like the file's, and a block needs only the file's next finer level under it, not
the finest one.

Zhang, Zhang, Zhang: GPU-based real-time terrain rendering algorithm using batched LOD. Journal of
Image and Graphics 17(4), 2012, pp. 582–588. Kovačević, Sweldens: Wavelet families of increasing
order in arbitrary dimensions. IEEE Transactions on Image Processing 9(3), 2000.
"""

import numpy as np

from terrainwave.coding.jit import kernel

# Weights of the nearest samples and of the others, on a line and in the middle of four.
_LINE = (9.0 / 16.0, -1.0 / 16.0)
_MIDDLE = (10.0 / 32.0, -1.0 / 32.0)


# Reach of the filters around samples.
RING = 3


@kernel
def _missed(height, near, far, n_near, near_weight, far_weight, order):
    """Return a height less its prediction by sums: of order 4 if possible, else 2, else 0."""
    if order == 4:
        apart = height - (near_weight * near + far_weight * far)
        if not np.isnan(apart):
            return apart
    apart = height - near / n_near
    return 0.0 if np.isnan(apart) else apart


@kernel
def fill_details(fine, order, out):
    """Fill `out` with samples of odd rows or columns less their predictions by even ones.

    `fine` and `out`, float64 (2n + 5, 2m + 5), are samples in a ring of `RING`, NaN where unknown.
    Where samples needed by order 4 are NaN, order 2 predicts; where its are, the detail is 0.
    """
    out[:] = 0.0
    for r in range(RING, fine.shape[0] - RING):
        above, below = fine[r - 1], fine[r + 1]
        here, high, low = fine[r], fine[r - 3], fine[r + 3]
        if r % 2:  # even rows of samples, as the ring is odd
            for c in range(RING + 1, fine.shape[1] - RING, 2):
                near, far = here[c - 1] + here[c + 1], here[c - 3] + here[c + 3]
                out[r, c] = _missed(here[c], near, far, 2, _LINE[0], _LINE[1], order)
            continue
        for c in range(RING, fine.shape[1] - RING, 2):
            near, far = above[c] + below[c], high[c] + low[c]
            out[r, c] = _missed(here[c], near, far, 2, _LINE[0], _LINE[1], order)
        for c in range(RING + 1, fine.shape[1] - RING, 2):
            near = above[c - 1] + above[c + 1] + below[c - 1] + below[c + 1]
            far = high[c - 1] + high[c + 1] + low[c - 1] + low[c + 1]
            far += above[c - 3] + above[c + 3] + below[c - 3] + below[c + 3]
            out[r, c] = _missed(here[c], near, far, 4, _MIDDLE[0], _MIDDLE[1], order)


@kernel
def _line_update(details, r, c, r_step, c_step, order):
    near = details[r - r_step, c - c_step] + details[r + r_step, c + c_step]
    if order == 2:
        return near / 2
    r_step, c_step = 3 * r_step, 3 * c_step
    far = details[r - r_step, c - c_step] + details[r + r_step, c + c_step]
    return _LINE[0] * near + _LINE[1] * far


@kernel
def _middle_update(details, r, c, order):
    above, below = details[r - 1], details[r + 1]
    near = above[c - 1] + above[c + 1] + below[c - 1] + below[c + 1]
    if order == 2:
        return near / 4
    high, low = details[r - 3], details[r + 3]
    far = above[c - 3] + above[c + 3] + below[c - 3] + below[c + 3]
    far += high[c - 1] + high[c + 1] + low[c - 1] + low[c + 1]
    return _MIDDLE[0] * near + _MIDDLE[1] * far


@kernel
def update(fine, details, order, coarse):
    """Change `coarse`, float64 (n, m), to the level above `fine` and `details` of `fill_details`.

    Samples that are void in `fine` do not change. Those on the block's border depend only on that
    line, so that neighbours have the same ones, and corners do not change. No sample leaves the
    range of the adjacent samples of `fine`.
    """
    last_row, last_col = coarse.shape[0] - 1, coarse.shape[1] - 1
    for row in range(last_row + 1):
        is_end_row = row in (0, last_row)
        for col in range(last_col + 1):
            is_end_col = col in (0, last_col)
            r, c = 2 * row + RING, 2 * col + RING
            height = fine[r, c]
            if np.isnan(height):
                continue
            change = 0.0
            if not (is_end_row or is_end_col):
                change = _line_update(details, r, c, 0, 1, order)
                change += _line_update(details, r, c, 1, 0, order)
                change = (change + _middle_update(details, r, c, order)) / 4
            elif not is_end_row:
                change = _line_update(details, r, c, 1, 0, order) / 2
            elif not is_end_col:
                change = _line_update(details, r, c, 0, 1, order) / 2
            low, high = height, height
            r_reach, c_reach = 0 if is_end_row else 1, 0 if is_end_col else 1
            for i in range(r - r_reach, r + r_reach + 1):
                for j in range(c - c_reach, c + c_reach + 1):
                    beside = fine[i, j]  # NaN changes nothing
                    if beside < low:
                        low = beside
                    if beside > high:
                        high = beside
            coarse[row, col] = min(max(height + change, low), high)


def filtered(fine, valid, order, coarse):
    """Return the level above `fine`, float64 (n, m); `coarse` has its heights where `fine` is void.

    `fine` and `valid` have the shape (2n - 1, 2m - 1); `order` is 2 or 4.
    """
    known = np.pad(np.where(valid, fine, np.nan), RING, constant_values=np.nan)
    details, out = np.empty_like(known), coarse.copy()
    fill_details(known, order, details)
    update(known, details, order, out)
    return out
