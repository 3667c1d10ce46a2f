"""Models that are mixed, and the encoder (docs/FORMAT.md §6.3, docs/format-predictive.md P.1)."""

import math

from terrainwave.reference.basics import ceil_div
from terrainwave.reference.range_coder import RangeDecoder


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


class MixingDecoder(RangeDecoder):
    """A range decoder whose bits may have two models."""

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
