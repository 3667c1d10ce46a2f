"""Eight-bit codes of errors and boxes of blocks (FORMAT.md §4.4)."""

# Of a mesh above the finest level whose error is not measured: its bound is computed with the mesh.
# As an error it exceeds that of any mesh, as the format requires (FORMAT.md §4.4).
UNMEASURED = 255


# An error code c means (8 + c % 8) * 2^(c // 8) / 8, rounded down: eight steps an octave.
def encode_error(error: int) -> int:
    """Return the smallest code of an error of at least `error` quanta (0 … 2^31)."""
    if error <= 0:
        return 0
    exponent = max(error.bit_length() - 1, 0)
    for code in range(8 * exponent, 8 * exponent + 9):
        if code and decode_error(code) >= error:
            return min(code, 255)
    return 255


def decode_error(code: int) -> int:
    """Return the error in quanta of `code` (0 … 255)."""
    return 0 if code == 0 else ((8 + code % 8) << code // 8) >> 3


def encode_range(low: int, high: int, outer_low: int, outer_high: int) -> tuple[int, int]:
    span = outer_high - outer_low
    if span <= 0 or low > high:
        return 0, 0
    below = (low - outer_low) * 255 // span
    above = (outer_high - high) * 255 // span
    return min(max(below, 0), 255), min(max(above, 0), 255)


def decode_range(below: int, above: int, outer_low: int, outer_high: int) -> tuple[int, int]:
    span = outer_high - outer_low
    return outer_low + below * span // 255, outer_high - above * span // 255
