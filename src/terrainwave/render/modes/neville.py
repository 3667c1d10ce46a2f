"""Neville filters of order 2 or 4 (Kovačević, Sweldens 2000) as Zhang et al. 2012, §1, have them.

They predict a sample from those around it: on a line from the two beside it by ½, or from four by
9/16 and -1/16; in the middle of four by ¼ each, or by 10/32 each less 1/32 of the eight beside
those (Zhang et al., fig. 2). A level is made of the finer one by their update, a quarter of the
transposed filters: half of it on a line. Samples of levels then nest as the file's do, and no level
has to be made of the finest one: that of one block needs the file's next finer level under it.

Zhang, Zhang, Zhang: GPU-based real-time terrain rendering algorithm using batched LOD. Journal of
Image and Graphics 17(4), 2012, pp. 582–588. Kovačević, Sweldens: Wavelet families of increasing
order in arbitrary dimensions. IEEE Transactions on Image Processing 9(3), 2000.
"""

import numpy as np

from terrainwave.coding.jit import kernel

ORDERS = 2, 4
# Weights of the nearest samples and of the others, on a line and in the middle of four.
_LINE = (9.0 / 16.0, -1.0 / 16.0)
_MIDDLE = (10.0 / 32.0, -1.0 / 32.0)


@kernel
def _has(valid, row, col):
    return 0 <= row < valid.shape[0] and 0 <= col < valid.shape[1] and valid[row, col]


@kernel
def _on_line(fine, valid, row, col, is_row, order):
    """Return how far a sample is from what those on its row or column predict; 0 if they can't."""
    r, c = (0, 1) if is_row else (1, 0)
    if not (_has(valid, row - r, col - c) and _has(valid, row + r, col + c)):
        return 0.0
    near = fine[row - r, col - c] + fine[row + r, col + c]
    r, c = 3 * r, 3 * c
    if order == 4 and _has(valid, row - r, col - c) and _has(valid, row + r, col + c):
        far = fine[row - r, col - c] + fine[row + r, col + c]
        return fine[row, col] - (_LINE[0] * near + _LINE[1] * far)
    return fine[row, col] - near / 2


@kernel
def _in_middle(fine, valid, row, col, order):
    """Return how far a sample is from what those around it predict; 0 if they cannot."""
    near, far, is_far = 0.0, 0.0, order == 4
    for r in (-1, 1):
        for c in (-1, 1):
            if not _has(valid, row + r, col + c):
                return 0.0
            near += fine[row + r, col + c]
            if is_far and _has(valid, row + 3 * r, col + c) and _has(valid, row + r, col + 3 * c):
                far += fine[row + 3 * r, col + c] + fine[row + r, col + 3 * c]
            else:
                is_far = False
    if is_far:
        return fine[row, col] - (_MIDDLE[0] * near + _MIDDLE[1] * far)
    return fine[row, col] - near / 4


@kernel
def fill_details(fine, valid, order, out):
    """Fill `out` with how far samples of odd rows or columns are from what even ones predict.

    `fine` and `out` are float64 of odd shape, `valid` says which samples are not void. Where those
    of order 4 are void or outside, order 2 predicts; where its are, the detail is 0.
    """
    for row in range(fine.shape[0]):
        for col in range(fine.shape[1]):
            out[row, col] = 0.0
            if not valid[row, col]:
                continue
            if row % 2 and col % 2:
                out[row, col] = _in_middle(fine, valid, row, col, order)
            elif row % 2 or col % 2:
                out[row, col] = _on_line(fine, valid, row, col, col % 2 == 1, order)


@kernel
def _detail(details, row, col):
    if 0 <= row < details.shape[0] and 0 <= col < details.shape[1]:
        return details[row, col]
    return 0.0


@kernel
def _line_update(details, row, col, is_row, order):
    r, c = (0, 1) if is_row else (1, 0)
    near = _detail(details, row - r, col - c) + _detail(details, row + r, col + c)
    if order == 2:
        return near / 2
    r, c = 3 * r, 3 * c
    far = _detail(details, row - r, col - c) + _detail(details, row + r, col + c)
    return _LINE[0] * near + _LINE[1] * far


@kernel
def _middle_update(details, row, col, order):
    near, far = 0.0, 0.0
    for r in (-1, 1):
        for c in (-1, 1):
            near += _detail(details, row + r, col + c)
            far += _detail(details, row + 3 * r, col + c) + _detail(details, row + r, col + 3 * c)
    return near / 4 if order == 2 else _MIDDLE[0] * near + _MIDDLE[1] * far


@kernel
def update(fine, valid, details, order, coarse):
    """Change `coarse`, float64 (n, m), to the level above `fine`, (2n - 1, 2m - 1), of a block.

    Samples that are void in `fine` stay. Those on the block's border follow from that line alone,
    so that its neighbours have the same, and its corners stay. None leaves the range of the valid
    samples of `fine` beside it.
    """
    last_row, last_col = fine.shape[0] - 1, fine.shape[1] - 1
    for row in range(0, last_row + 1, 2):
        is_end_row = row in (0, last_row)
        for col in range(0, last_col + 1, 2):
            is_end_col = col in (0, last_col)
            if not valid[row, col]:
                continue
            change, low, high = 0.0, fine[row, col], fine[row, col]
            if is_end_row and is_end_col:
                pass
            elif is_end_row or is_end_col:
                change = _line_update(details, row, col, is_end_row, order) / 2
            else:
                change = _line_update(details, row, col, True, order)
                change += _line_update(details, row, col, False, order)
                change = (change + _middle_update(details, row, col, order)) / 4
            for r in range(0 if is_end_row else -1, 1 if is_end_row else 2):
                for c in range(0 if is_end_col else -1, 1 if is_end_col else 2):
                    if valid[row + r, col + c]:
                        low = min(low, fine[row + r, col + c])
                        high = max(high, fine[row + r, col + c])
            coarse[row // 2, col // 2] = min(max(fine[row, col] + change, low), high)


def filtered(fine, valid, order, coarse):
    """Return the level above `fine`; `coarse` has its heights where those of `fine` are void.

    Parameters
    ----------
    fine, valid : ndarray of float64 and of bool, shape (2n - 1, 2m - 1)
    order : int
        One of `ORDERS`.
    coarse : ndarray of float64, shape (n, m)
        NaN where there are none either.
    """
    details, out = np.empty_like(fine), coarse.copy()
    fill_details(fine, valid, order, details)
    update(fine, valid, details, order, out)
    return out
