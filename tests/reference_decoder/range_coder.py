"""The range coder, magnitudes and bins (docs/FORMAT.md §6)."""

import math

from reference_decoder.basics import ceil_div, require

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


def rounded(x):
    return math.floor(x + 0.5)


# Logits of probabilities, and probabilities of mixed logits (format-predictive.md P.1).
LOGITS = [rounded(256 * math.log((2 * k + 1) / (2047 - 2 * k))) for k in range(1024)]
MIXED = [rounded(65536 / (1 + math.exp((703 - 2 * k) / 64))) for k in range(704)]


class Mixers:
    """Pairs of weights (format-predictive.md P.1)."""

    def __init__(self, n):
        self.weights = [(32768, 32768)] * n

    def mixed(self, models, a, b, i):
        """Return m and the models' logits."""
        logits = [LOGITS[models.probability[model] >> 12] for model in (a, b)]
        x = sum(v * s for v, s in zip(self.weights[i], logits, strict=True)) >> 19
        return MIXED[min(max(x, -352), 351) + 352], logits

    def update(self, i, m, logits, bit):
        self.weights[i] = tuple(
            v + ((32768 - m * s) >> 16) + bit * s
            for v, s in zip(self.weights[i], logits, strict=True)
        )


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

    def mean_bit(self, models, a, b):
        """Read a bit by the mean of two models (format-predictive.md P.1)."""
        mean = (models.probability[a] + models.probability[b]) >> 7
        bit = self._split((self.range >> 16) * (mean | 1))
        models.update(a, bit)
        models.update(b, bit)
        self._renormalise()
        return bit

    def mixed_bit(self, models, a, b, mixers, i):
        """Read a bit by two models and a mixer (format-predictive.md P.1)."""
        m, logits = mixers.mixed(models, a, b, i)
        bit = self._split((self.range >> 16) * m)
        models.update(a, bit)
        models.update(b, bit)
        mixers.update(i, m, logits, bit)
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


class RangeEncoder:
    """§6.3."""

    def __init__(self):
        self.low = 0
        self.range = 2**32 - 1
        self.cache = 0
        self.pending = 1
        self.out = bytearray()

    def _shift(self):
        if self.low < 0xFF000000 or self.low >= 2**32:
            carry = self.low >> 32
            if self.pending:
                self.out.append((self.cache + carry) % 256)
            self.out += bytes([(255 + carry) % 256]) * (self.pending - 1)
            self.pending = 0
            self.cache = (self.low >> 24) & 255
        self.pending += 1
        self.low = (self.low & 0xFFFFFF) << 8

    def _renormalise(self):
        while self.range < 2**24:
            self.range <<= 8
            self._shift()

    def _split(self, bound, bit):
        if bit:
            self.range = bound
        else:
            self.low += bound
            self.range -= bound

    def bit(self, models, i, bit):
        self._split((self.range >> 16) * ((models.probability[i] >> 6) | 1), bit)
        models.update(i, bit)
        self._renormalise()

    def mean_bit(self, models, a, b, bit):
        mean = (models.probability[a] + models.probability[b]) >> 7
        self._split((self.range >> 16) * (mean | 1), bit)
        models.update(a, bit)
        models.update(b, bit)
        self._renormalise()

    def mixed_bit(self, models, a, b, mixers, i, bit):
        m, logits = mixers.mixed(models, a, b, i)
        self._split((self.range >> 16) * m, bit)
        models.update(a, bit)
        models.update(b, bit)
        mixers.update(i, m, logits, bit)
        self._renormalise()

    def raw(self, value, k):
        for i in reversed(range(k)):
            self.range >>= 1
            if value >> i & 1:
                self.low += self.range
            self._renormalise()

    def end(self):
        self.low = ceil_div(self.low, 2**24) * 2**24
        self._shift()
        self._shift()
        return bytes(self.out[1:])
