/** From quantum numbers to raw heights (FORMAT.md §2.3, §5.3). */

import { require } from "./errors.js";

/** Return the whole number nearest to x, ties to even. */
function roundToEven(x) {
  const low = Math.floor(x);
  const rest = x - low; // exact: x and low are within a factor of two, or x is whole
  if (rest < 0.5 || (rest === 0.5 && low % 2 === 0)) return low;
  return low + 1;
}

/** Makes raw heights of the file's dtype. */
export class Heights {
  constructor(header, metadata) {
    const { quantumNum, quantumDen, base, dtype } = header;
    this.dtype = dtype;
    this.isFloat = dtype.range === null;
    const exact = ((base < 0n ? -base : base) + 2n ** 31n) * quantumNum < 2n ** 53n;
    const [num, den] = [Number(quantumNum), Number(quantumDen)];
    const first = Number(base);
    // Doubles hold (base + k) · num exactly, or BigInt does; rounding to binary64 is to even.
    this.product = exact
      ? (k) => (first + k) * num
      : (k) => Number((base + BigInt(k)) * quantumNum);
    this.hasFraction = quantumDen !== 1n;
    Object.assign(this, { first, num, den });
    this.nodata = this.nodataIn(metadata.nodata);
    this.quantaOfNodata = this.findQuantaOfNodata(header);
    this.isPlain = exact && (this.isFloat || (!this.hasFraction && this.isInRange(header)));
  }

  /** Return the nodata value in the dtype, or null (§2.3). */
  nodataIn(value) {
    if (value === undefined) return null;
    const number = { nan: NaN, inf: Infinity, "-inf": -Infinity }[value] ?? value;
    return this.dtype.name === "float32" ? Math.fround(number) : number;
  }

  /** Say whether no height of the file needs to be clipped to the range of an integer dtype. */
  isInRange({ zMin, zMax }) {
    const [low, high] = this.dtype.range;
    return this.product(zMin - 1) >= low && this.product(zMax + 1) <= high;
  }

  /** Return what void samples hold. */
  get void() {
    return this.nodata ?? (this.isFloat ? NaN : 0);
  }

  /** Return the raw height of a quantum number. */
  raw(k) {
    const p = this.product(k);
    const quotient = this.hasFraction ? p / this.den : p;
    if (this.isFloat) return this.dtype.name === "float32" ? Math.fround(quotient) : quotient;
    const [low, high] = this.dtype.range;
    return Math.min(Math.max(roundToEven(quotient), low), high);
  }

  /** Return [a, b], the quantum numbers in [z_min, z_max] that become nodata, or null (§5.1). */
  findQuantaOfNodata({ zMin, zMax }) {
    const { nodata } = this;
    if (nodata === null || !Number.isFinite(nodata)) return null;
    const first = (isReached) => {
      let low = zMin; // by bisection: raw heights never fall
      let high = zMax + 1;
      while (low < high) {
        const middle = Math.floor((low + high) / 2);
        if (isReached(this.raw(middle))) high = middle;
        else low = middle + 1;
      }
      return low;
    };
    const a = first((z) => z >= nodata);
    const b = first((z) => z > nodata) - 1;
    return a <= b ? [a, b] : null;
  }

  /**
   * Write raw heights of part of a unit's region to `out`.
   *
   * `from` and `to` are first places in the region and in `out`, of n samples of a row.
   */
  write(out, to, { heights, valid, hasVoid, remainders }, from, n) {
    const empty = this.void;
    if (this.isPlain && this.num === 1 && this.den === 1 && !hasVoid) {
      const { first } = this;
      for (let i = 0; i < n; i++) out[to + i] = first + heights[from + i];
    } else if (this.isPlain && this.num === 1 && this.den === 1) {
      const { first } = this;
      for (let i = 0; i < n; i++) out[to + i] = valid[from + i] ? first + heights[from + i] : empty;
    } else if (this.isPlain) {
      const { first, num, den } = this; // where den is 1, dividing by it changes nothing
      for (let i = 0; i < n; i++) {
        out[to + i] = valid[from + i] ? ((first + heights[from + i]) * num) / den : empty;
      }
    } else {
      for (let i = 0; i < n; i++) {
        out[to + i] = valid[from + i] ? this.raw(heights[from + i]) : empty;
      }
    }
    if (remainders !== null) this.addRemainders(out, to, valid, remainders, from, n);
  }

  /** §5.3: numbers of heights in their order grow by the remainders. */
  addRemainders(out, to, valid, { low, high }, from, n) {
    const at = out.byteOffset + to * this.dtype.bytes;
    if (this.dtype.bytes === 4) {
      const bits = new Int32Array(out.buffer, at, n);
      for (let i = 0; i < n; i++) {
        if (!valid[from + i]) continue;
        const number = (this.swap(bits[i]) + low[from + i]) | 0;
        bits[i] = this.swap(number);
        if (this.isFloat) require(Number.isFinite(out[to + i]), "a height that is not finite");
      }
      return;
    }
    const bits = new BigInt64Array(out.buffer, at, n);
    const most = 2n ** 63n - 1n;
    for (let i = 0; i < n; i++) {
      if (!valid[from + i] || (low[from + i] === 0 && high[from + i] === 0)) continue;
      const remainder = (BigInt(high[from + i]) << 32n) | BigInt(low[from + i] >>> 0);
      const before = bits[i] >= 0n ? bits[i] : bits[i] ^ most;
      const number = BigInt.asIntN(64, before + remainder);
      bits[i] = number >= 0n ? number : number ^ most;
      require(Number.isFinite(out[to + i]), "a height that is not finite");
    }
  }

  /** Exchange the bits of a float and its number in the order of floats; integers stay. */
  swap(bits) {
    return bits >= 0 || !this.isFloat ? bits : bits ^ 0x7fffffff;
  }
}
