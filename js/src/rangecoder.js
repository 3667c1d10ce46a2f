/** The range coder and its models (FORMAT.md §6). */

import { require } from "./errors.js";

export const ONE = 2 ** 22; // a probability of 1
/** By bits seen, how fast a model learns, in 1/65536. */
export const RATES = Int32Array.from({ length: 255 }, (_, c) => Math.floor(131072 / (2 * c + 3)));

/** Return (x · rate) >> 16 for x of 22 bits and a rate of 16, in products of 32 bits. */
export function scaled(x, rate) {
  return (Math.imul(x >>> 8, rate) + (Math.imul(x & 255, rate) >>> 8)) >>> 8;
}

/** Adaptive models (P, c) (§6.1). */
export class Models {
  /** `starts`: pairs written as in §7.8, v = P / 2^10 · 16 + c / 2; without, all are (2^21, 0). */
  constructor(n, starts = null) {
    this.probability = new Int32Array(n).fill(ONE / 2);
    this.count = new Uint8Array(n);
    if (starts) {
      for (let i = 0; i < n; i++) {
        this.probability[i] = (starts[i] >> 4) << 10;
        this.count[i] = 2 * (starts[i] & 15);
      }
    }
  }

  update(i, bit) {
    const p = this.probability[i];
    const count = this.count[i];
    const rate = RATES[count];
    this.probability[i] = bit ? p + scaled(ONE - p, rate) : p - scaled(p, rate);
    if (count < 254) this.count[i] = count + 1;
  }
}

/** §6.2. range and code are kept as int32 whose bits are those of uint32. */
export class RangeDecoder {
  constructor(data) {
    this.data = data;
    this.range = -1;
    this.code = 0;
    this.position = 0;
    for (let i = 0; i < 4; i++) this.code = (this.code << 8) | this.nextByte();
  }

  nextByte() {
    const at = this.position++;
    return at < this.data.length ? this.data[at] : 0;
  }

  renormalise() {
    while (this.range >>> 24 === 0) {
      this.code = (this.code << 8) | this.nextByte();
      this.range <<= 8;
    }
  }

  /** Read a bit that is 1 with the probability p / 65536; the range is not renormalised. */
  split(p) {
    const bound = Math.imul(this.range >>> 16, p);
    if (this.code >>> 0 < bound >>> 0) {
      this.range = bound;
      return 1;
    }
    this.code = (this.code - bound) | 0;
    this.range = (this.range - bound) | 0;
    return 0;
  }

  bit(models, i) {
    const bit = this.split((models.probability[i] >> 6) | 1);
    models.update(i, bit);
    this.renormalise();
    return bit;
  }

  /** Return k <= 31 raw bits, the most significant first. */
  raw(k) {
    let value = 0;
    for (; k > 0; k--) {
      this.range >>>= 1;
      value *= 2;
      if (this.code >>> 0 >= this.range >>> 0) {
        this.code = (this.code - this.range) | 0;
        value++;
      }
      this.renormalise();
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
    require(this.position - 3 === this.data.length, "a range coder stream has another length");
  }
}
