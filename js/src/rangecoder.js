/** The range coder and its models (FORMAT.md §6). */

import { require } from "./errors.js";

export const ONE = 2 ** 22; // a probability of 1
/** By bits seen, how fast a model learns, in 1/65536. */
export const RATES = Int32Array.from({ length: 255 }, (_, c) => Math.floor(131072 / (2 * c + 3)));

/** Return (x · rate) >> 16 for x of 22 bits and a rate of 16, in products of 32 bits. */
export function scaled(x, rate) {
  return (Math.imul(x >>> 8, rate) + (Math.imul(x & 255, rate) >>> 8)) >>> 8;
}

/**
 * Adaptive models (P, c) (§6.1). `cells` holds P · 256 + c of each: one load and one store of what
 * is read and written for every bit.
 */
export class Models {
  /** `starts`: pairs written as in §7.8, v = P / 2^10 · 16 + c / 2; without, all are (2^21, 0). */
  constructor(n, starts = null) {
    this.cells = starts ? Int32Array.from(starts, (v) => ((v >> 4) << 18) | (2 * (v & 15)))
      : new Int32Array(n).fill((ONE / 2) << 8);
  }

  /** Return models that begin as these are. */
  copy() {
    return Object.assign(Object.create(Models.prototype), { cells: this.cells.slice() });
  }
}

/** Return a model after a bit. */
export function learned(cell, bit) {
  const p = cell >>> 8;
  const count = cell & 255;
  const rate = RATES[count];
  const change = bit ? scaled(ONE - p, rate) : -scaled(p, rate);
  return (cell + (change << 8) + (count < 254 ? 1 : 0)) | 0;
}

/** Places in a decoder's state. */
const [RANGE, CODE, POSITION] = [0, 1, 2];

/**
 * §6.2. range and code are kept as int32 whose bits are those of uint32, in a typed array: fields of
 * objects hold 31 bits in browsers, and numbers on the heap beyond.
 */
export class RangeDecoder {
  constructor(data) {
    this.data = data;
    this.state = Int32Array.of(-1, 0, 4);
    for (let i = 0; i < 4; i++) {
      this.state[CODE] = (this.state[CODE] << 8) | (i < data.length ? data[i] : 0);
    }
  }

  /** Read a bit that is 1 with the probability p / 65536. */
  split(p) {
    const { data, state } = this;
    let range = state[RANGE];
    let code = state[CODE];
    const bound = Math.imul(range >>> 16, p);
    let bit = 1;
    if (code >>> 0 < bound >>> 0) {
      range = bound;
    } else {
      bit = 0;
      code = (code - bound) | 0;
      range = (range - bound) | 0;
    }
    while (range >>> 24 === 0) {
      const at = state[POSITION]++;
      code = (code << 8) | (at < data.length ? data[at] : 0);
      range <<= 8;
    }
    state[RANGE] = range;
    state[CODE] = code;
    return bit;
  }

  bit(models, i) {
    const { cells } = models;
    const cell = cells[i];
    const bit = this.split((cell >>> 14) | 1);
    cells[i] = learned(cell, bit);
    return bit;
  }

  /** Return k <= 31 raw bits, the most significant first. */
  raw(k) {
    const { data, state } = this;
    let value = 0;
    for (; k > 0; k--) {
      state[RANGE] >>>= 1;
      value *= 2;
      if (state[CODE] >>> 0 >= state[RANGE] >>> 0) {
        state[CODE] -= state[RANGE];
        value++;
      }
      while (state[RANGE] >>> 24 === 0) {
        const at = state[POSITION]++;
        state[CODE] = (state[CODE] << 8) | (at < data.length ? data[at] : 0);
        state[RANGE] <<= 8;
      }
    }
    return value;
  }

  /** Count the ones before the first zero, at most `limit` of them. */
  unary(models, first, limit) {
    let n = 0;
    while (n < limit && this.bit(models, first + n)) n++;
    return n;
  }

  /** §6.5; may be as large as 2^31 + 2^k · 14. */
  magnitude(models, first, prefix, k) {
    const u = this.unary(models, first, 14);
    if (u < 14) return u * 2 ** k + this.raw(k);
    const e = this.unary(models, prefix, 31);
    return 13 * 2 ** k + 2 ** (e + k) + this.raw(e + k);
  }

  end() {
    require(this.state[POSITION] - 3 === this.data.length, "a range coder stream has another length");
  }
}
