"""The range coder, magnitudes and bins (docs/FORMAT.md §6)."""

from terrainwave.reference.basics import require

M = 2**30  # the largest height in magnitude
THRESHOLDS = [1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32, 40, 51, 64, 81, 102, 128, 162, 204, 256]
THRESHOLDS += [324, 408, 512, 648, 816, 1024, 1296, 1632, 2048, 2592, 3264]


def bin_of(s):
    """§6.6."""
    return sum(threshold <= s for threshold in THRESHOLDS)


def lg(v):
    """Eighths of octaves (§7.7, format-predictive.md P.6)."""
    for limit, shift in ((4096, 0), (2**20, 8), (2**28, 16)):
        if v < limit:
            v >>= shift
            return (v**8).bit_length() - 1 + 8 * shift if v else 0
    return lg(min(v >> 24, 4095)) + 192


class Models:
    """Adaptive models (P, c) (§6.1)."""

    def __init__(self, n, starts=None):
        self.probability = [2**21] * n
        self.count = [0] * n
        if starts is not None:  # §7.8
            assert len(starts) == n
            self.probability = [(v >> 4) << 10 for v in starts]
            self.count = [2 * (v & 15) for v in starts]

    def update(self, i, bit):
        rate = 131072 // (2 * self.count[i] + 3)
        p = self.probability[i]
        self.probability[i] += ((2**22 - p) * rate) >> 16 if bit else -((p * rate) >> 16)
        self.count[i] = min(self.count[i] + 1, 254)


class RangeDecoder:
    """§6.2."""

    def __init__(self, data):
        self.data = data
        self.range = 2**32 - 1
        self.code = int.from_bytes(data[:4].ljust(4, b"\0"), "big")
        self.position = 4

    def _renormalise(self):
        while self.range < 2**24:
            byte = self.data[self.position] if self.position < len(self.data) else 0
            self.code = ((self.code << 8) | byte) & (2**32 - 1)
            self.range <<= 8
            self.position += 1

    def _split(self, bound):
        bit = int(self.code < bound)
        if bit:
            self.range = bound
        else:
            self.code -= bound
            self.range -= bound
        return bit

    def bit(self, models, i):
        bit = self._split((self.range >> 16) * ((models.probability[i] >> 6) | 1))
        models.update(i, bit)
        self._renormalise()
        return bit

    def raw(self, k):
        value = 0
        for _ in range(k):
            self.range >>= 1
            bit = int(self.code >= self.range)
            if bit:
                self.code -= self.range
            value = 2 * value + bit
            self._renormalise()
        return value

    def end(self):
        require(self.position - 3 == len(self.data), "range coder stream has another length")

    def unary(self, models, first, limit):
        """Count the ones before the first zero, `limit` of them at most."""
        n = 0
        while n < limit and self.bit(models, first + n):
            n += 1
        return n

    def magnitude(self, models, first, prefix, k):
        """§6.5."""
        u = self.unary(models, first, 14)
        if u < 14:
            return (u << k) | self.raw(k)
        e = self.unary(models, prefix, 31)
        r = self.raw(e + k)
        return (14 << k) + ((1 << (e + k)) | r) - (1 << k)
