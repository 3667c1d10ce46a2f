"""Remainders of a unit as bytes: byte planes, deflated (FORMAT.md §5.3).

They are mostly noise below the vertical quantum, so nothing predicts them; deflate only finds out
how few bits they have, plane by plane.
"""

import zlib

import numpy as np

from terrainwave.coding.deflate import inflate
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.remainders import Remainders


def encode_remainders(rest: Remainders) -> bytes:
    """Return the section of remainders; empty if all are 0."""
    width = rest.itemsize
    sign = rest >> (8 * width - 1)
    zigzag = ((rest << 1) ^ sign).astype(f"<i{width}").reshape(-1)
    planes = zigzag.view(np.uint8).reshape(-1, width).T
    used = np.flatnonzero(planes.any(axis=1))
    if not used.size:
        return b""
    n_planes = int(used[-1]) + 1
    # Noise only has runs and frequencies of bytes.
    stream = zlib.compressobj(9, strategy=zlib.Z_RLE)
    data = np.ascontiguousarray(planes[:n_planes]).tobytes()
    return bytes([n_planes]) + stream.compress(data) + stream.flush()


def decode_remainders(section: bytes, shape: tuple[int, int], width: int) -> Remainders:
    """Undo `encode_remainders`.

    Parameters
    ----------
    width : int
        Bytes of a sample: 4 or 8.

    Raises
    ------
    CorruptStreamError
        If the section contradicts the format; it never inflates to more than `shape` takes.
    """
    n_planes, n_samples = section[0], shape[0] * shape[1]
    if not 1 <= n_planes <= width:
        raise CorruptStreamError(f"remainders of {n_planes} bytes, expected 1 to {width}")
    data = inflate(section[1:], n_planes * n_samples, "a section of remainders")
    if len(data) != n_planes * n_samples:
        raise CorruptStreamError(
            f"a section of remainders inflates to {len(data)} bytes, not {n_planes * n_samples}"
        )
    planes = np.frombuffer(data, dtype=np.uint8).reshape(n_planes, n_samples)
    zigzag = np.zeros((n_samples, width), dtype=np.uint8)
    zigzag[:, :n_planes] = planes.T
    numbers = zigzag.view(f"<u{width}").astype(f"=u{width}")[:, 0]
    rest: Remainders = ((numbers >> 1) ^ -(numbers & 1)).view(f"i{width}").reshape(shape)
    return rest
