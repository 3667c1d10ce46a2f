/** Bits by two models, and the scales of contexts (P.1, P.5, P.6; FORMAT.md §6.6). */

/** Logits of probabilities, and probabilities of mixed logits (P.1). */
const LOGITS = Float64Array.from({ length: 1024 }, (_, k) =>
  Math.floor(256 * Math.log((2 * k + 1) / (2047 - 2 * k)) + 0.5),
);
const MIXED = Int32Array.from({ length: 704 }, (_, k) =>
  Math.floor(65536 / (1 + Math.exp((703 - 2 * k) / 64)) + 0.5),
);

/** Read a bit by the mean of two models. */
export function meanBit(decoder, models, a, b) {
  const { probability } = models;
  const bit = decoder.split(((probability[a] + probability[b]) >> 7) | 1);
  models.update(a, bit);
  models.update(b, bit);
  decoder.renormalise();
  return bit;
}

/** Pairs of weights that mix two models. */
export class Mixers {
  constructor(n) {
    this.weights = new Float64Array(2 * n).fill(32768);
  }

  bit(decoder, models, a, b, i) {
    const { probability } = models;
    const { weights } = this;
    const s = LOGITS[probability[a] >> 12];
    const t = LOGITS[probability[b] >> 12];
    const x = Math.floor((weights[2 * i] * s + weights[2 * i + 1] * t) / 2 ** 19);
    const m = MIXED[Math.min(Math.max(x, -352), 351) + 352];
    const bit = decoder.split(m);
    models.update(a, bit);
    models.update(b, bit);
    weights[2 * i] += Math.floor((32768 - m * s) / 65536) + bit * s;
    weights[2 * i + 1] += Math.floor((32768 - m * t) / 65536) + bit * t;
    decoder.renormalise();
    return bit;
  }
}

// prettier-ignore
const THRESHOLDS = [
  1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32, 40, 51, 64, 81, 102, 128, 162, 204, 256, 324, 408,
  512, 648, 816, 1024, 1296, 1632, 2048, 2592, 3264,
];
const BINS = Uint8Array.from({ length: 4096 }, (_, s) => THRESHOLDS.filter((t) => t <= s).length);

/** Return the bin of a sum, at most 4095 (FORMAT.md §6.6). */
export const binOf = (s) => BINS[Math.min(s, 4095)];

/** By v, eighths of octaves: the largest g with 2^g <= v^8. */
const EIGHTHS = Uint8Array.from({ length: 4096 }, (_, v) =>
  v === 0 ? 0 : (BigInt(v) ** 8n).toString(2).length - 1,
);

/** P.6. */
export function lg(v) {
  if (v < 4096) return EIGHTHS[v];
  if (v < 2 ** 20) return EIGHTHS[v >> 8] + 64;
  if (v < 2 ** 28) return EIGHTHS[v >> 16] + 128;
  return EIGHTHS[Math.min(Math.floor(v / 2 ** 24), 4095)] + 192;
}

/** Counts quanta in steps (P.5). */
export class Scale {
  constructor(step) {
    this.shift = 0;
    while (Math.floor(step / 2 ** this.shift) >= 4096) this.shift++;
    this.unit = 2 ** this.shift;
    this.inverse = Math.floor(2 ** 22 / Math.floor(step / this.unit));
  }

  /** Return about d / step in 1 / 2^f; d >= 0. */
  steps(d, f) {
    const x = Math.floor(Math.min(d, 2 ** 40) / this.unit);
    const over = 2 ** (22 - f);
    if (x < 2 ** 31) return Math.floor((x * this.inverse) / over);
    // The product has more than 53 bits: in two parts, each exact.
    const high = Math.floor(x / 2 ** 20) * this.inverse;
    const low = (x % 2 ** 20) * this.inverse;
    if (over >= 2 ** 20) return Math.floor((high + Math.floor(low / 2 ** 20)) / (over / 2 ** 20));
    return high * (2 ** 20 / over) + Math.floor(low / over);
  }
}
