/** Bits by two models, and the scales of contexts (P.1, P.5, P.6; FORMAT.md §6.6). */

import { learned } from "./rangecoder.js";

/** Logits of probabilities, and probabilities of mixed logits (P.1). */
export const LOGITS = Int32Array.from({ length: 1024 }, (_, k) =>
  Math.floor(256 * Math.log((2 * k + 1) / (2047 - 2 * k)) + 0.5),
);
export const MIXED = Int32Array.from({ length: 704 }, (_, k) =>
  Math.floor(65536 / (1 + Math.exp((703 - 2 * k) / 64)) + 0.5),
);

// Below, the same model twice stands for one model: it learns once, as both are read before.

/** Read a bit by the mean of two models. */
export function meanBit(decoder, cells, a, b) {
  const first = cells[a];
  const second = cells[b];
  const bit = decoder.split((((first >>> 8) + (second >>> 8)) >> 7) | 1);
  cells[a] = learned(first, bit);
  cells[b] = learned(second, bit);
  return bit;
}

/** Pairs of weights that mix two models. */
export class Mixers {
  constructor(n) {
    this.weights = new Float64Array(2 * n).fill(32768); // may need more than 32 bits
  }

  bit(decoder, cells, a, b, i) {
    const { weights } = this;
    const first = cells[a];
    const second = cells[b];
    const s = LOGITS[first >>> 20];
    const t = LOGITS[second >>> 20];
    const x = (weights[2 * i] * s + weights[2 * i + 1] * t) * 2 ** -19;
    const m = MIXED[x < -352 ? 0 : x >= 351 ? 703 : Math.floor(x) + 352];
    const bit = decoder.split(m);
    cells[a] = learned(first, bit);
    cells[b] = learned(second, bit);
    weights[2 * i] += ((32768 - Math.imul(m, s)) >> 16) + (bit ? s : 0);
    weights[2 * i + 1] += ((32768 - Math.imul(m, t)) >> 16) + (bit ? t : 0);
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
export const EIGHTHS = Uint8Array.from({ length: 4096 }, (_, v) =>
  v === 0 ? 0 : (BigInt(v) ** 8n).toString(2).length - 1,
);

/** P.6. */
export function lg(v) {
  if (v < 4096) return EIGHTHS[v];
  if (v < 2 ** 20) return EIGHTHS[v >> 8] + 64;
  if (v < 2 ** 28) return EIGHTHS[v >> 16] + 128;
  return EIGHTHS[Math.min(Math.floor(v / 2 ** 24), 4095)] + 192;
}

/** 2^f, -16 <= f < 48: powers by `**` are calls. */
const POWERS = Float64Array.from({ length: 64 }, (_, i) => 2 ** (i - 16));
export const power = (f) => POWERS[f + 16];

/** Counts quanta in steps (P.5). */
export class Scale {
  constructor(step) {
    let shift = 0;
    while (Math.floor(step / 2 ** shift) >= 4096) shift++;
    this.unit = 2 ** shift;
    this.inverse = Math.floor(2 ** 22 / Math.floor(step / this.unit));
    this.perStep = this.inverse / 2 ** 22;
    this.most = shift === 0 ? 2 ** 31 : 0; // below it steps are products of less than 53 bits
  }

  /** Return about d / step in 1 / 2^f; d >= 0. */
  steps(d, f) {
    return d < this.most ? Math.floor(d * (this.perStep * POWERS[f + 16])) : this.largeSteps(d, f);
  }

  largeSteps(d, f) {
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
