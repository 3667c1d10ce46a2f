/**
 * Deflate (RFC 1951) with the limit of FORMAT.md §1.3, which holds while inflating, and with preset
 * dictionaries, which browsers' DecompressionStream does not know. As strict as zlib.
 */

import { require } from "./errors.js";

const LENGTH_BASE = [
  3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131,
  163, 195, 227, 258,
];
const LENGTH_BITS = [
  0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0,
];
const DISTANCE_BASE = [
  1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049,
  3073, 4097, 6145, 8193, 12289, 16385, 24577,
];
const DISTANCE_BITS = [
  0, 0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13,
];
const ORDER = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
const END_OF_BLOCK = 256;

/** Return { bits, table }: by the next `bits` bits, length of the code · 512 + symbol; 0: none. */
function makeTable(lengths, mayBeIncomplete) {
  const counts = new Int32Array(16);
  for (const length of lengths) counts[length]++;
  counts[0] = 0;
  let bits = 15;
  while (bits > 1 && counts[bits] === 0) bits--;
  let left = 1;
  let n = 0;
  for (let i = 1; i < 16; i++) {
    left = 2 * left - counts[i];
    n += counts[i];
    require(left >= 0, "deflate: code lengths are over-subscribed");
  }
  // zlib takes one code of one bit, or none, for distances alone.
  require(left === 0 || (mayBeIncomplete && (n === 0 || (n === 1 && counts[1] === 1))),
    "deflate: code lengths are incomplete");
  const next = new Int32Array(16);
  for (let i = 1, code = 0; i < 16; i++) {
    code = (code + counts[i - 1]) << 1;
    next[i] = code;
  }
  const table = new Uint16Array(1 << bits);
  for (let symbol = 0; symbol < lengths.length; symbol++) {
    const length = lengths[symbol];
    if (length === 0) continue;
    let reversed = 0;
    for (let i = 0, code = next[length]++; i < length; i++, code >>= 1) {
      reversed = (reversed << 1) | (code & 1);
    }
    for (let i = reversed; i < table.length; i += 1 << length) table[i] = (length << 9) | symbol;
  }
  return { bits, table };
}

let fixedTables = null;

function fixed() {
  if (fixedTables === null) {
    const lengths = new Uint8Array(288).fill(8);
    lengths.fill(9, 144, 256);
    lengths.fill(7, 256, 280);
    fixedTables = [makeTable(lengths, false), makeTable(new Uint8Array(32).fill(5), false)];
  }
  return fixedTables;
}

class Inflater {
  constructor(data, limit, dictionary) {
    this.data = data;
    this.at = 0;
    this.hold = 0; // bits that were taken from bytes and not used: at most 31
    this.nHeld = 0;
    this.nBefore = dictionary.length;
    this.limit = limit + this.nBefore;
    this.out = new Uint8Array(Math.min(this.limit, this.nBefore + 4 * data.length + 64));
    this.out.set(dictionary);
    this.n = this.nBefore;
  }

  need(n) {
    while (this.nHeld < n) {
      require(this.at < this.data.length, "deflated section ends early");
      this.hold |= this.data[this.at++] << this.nHeld;
      this.nHeld += 8;
    }
  }

  /** Return the next n <= 16 bits. */
  bits(n) {
    this.need(n);
    const value = this.hold & ((1 << n) - 1);
    this.hold >>>= n;
    this.nHeld -= n;
    return value;
  }

  symbol({ bits, table }) {
    while (this.nHeld < bits && this.at < this.data.length) {
      this.hold |= this.data[this.at++] << this.nHeld;
      this.nHeld += 8;
    }
    const entry = table[this.hold & ((1 << bits) - 1)];
    const length = entry >> 9;
    require(length > 0, "deflate: no such code");
    require(length <= this.nHeld, "deflated section ends early");
    this.hold >>>= length;
    this.nHeld -= length;
    return entry & 511;
  }

  reserve(n) {
    require(this.n + n <= this.limit, "inflates to more than its limit");
    if (this.n + n > this.out.length) {
      const larger = new Uint8Array(Math.min(this.limit, Math.max(2 * this.out.length, this.n + n)));
      larger.set(this.out);
      this.out = larger;
    }
  }

  stored() {
    const drop = this.nHeld & 7;
    this.hold >>>= drop;
    this.nHeld -= drop;
    const n = this.bits(16);
    require(this.bits(16) === (n ^ 0xffff), "deflate: length of a stored block");
    this.at -= this.nHeld >> 3; // whole bytes that were only looked at
    this.hold = this.nHeld = 0;
    require(this.at + n <= this.data.length, "deflated section ends early");
    this.reserve(n);
    this.out.set(this.data.subarray(this.at, this.at + n), this.n);
    this.at += n;
    this.n += n;
  }

  readTables() {
    const nLiterals = this.bits(5) + 257;
    const nDistances = this.bits(5) + 1;
    const nCodes = this.bits(4) + 4;
    require(nLiterals <= 286 && nDistances <= 30, "deflate: too many symbols");
    const codes = new Uint8Array(19);
    for (let i = 0; i < nCodes; i++) codes[ORDER[i]] = this.bits(3);
    const table = makeTable(codes, false);
    const lengths = new Uint8Array(nLiterals + nDistances);
    for (let i = 0; i < lengths.length; ) {
      const symbol = this.symbol(table);
      if (symbol < 16) {
        lengths[i++] = symbol;
        continue;
      }
      require(symbol > 16 || i > 0, "deflate: no length to repeat");
      const repeated = symbol === 16 ? lengths[i - 1] : 0;
      const n = symbol === 16 ? 3 + this.bits(2) : symbol === 17 ? 3 + this.bits(3) : 11 + this.bits(7);
      require(i + n <= lengths.length, "deflate: too many lengths");
      lengths.fill(repeated, i, i + n);
      i += n;
    }
    require(lengths[END_OF_BLOCK] > 0, "deflate: no end of block");
    // Of literals, too, zlib takes a single code of one bit: it is the end of the block.
    return [makeTable(lengths.subarray(0, nLiterals), true), makeTable(lengths.subarray(nLiterals), true)];
  }

  compressed([literals, distances]) {
    for (;;) {
      const symbol = this.symbol(literals);
      if (symbol < END_OF_BLOCK) {
        if (this.n === this.out.length) this.reserve(1);
        this.out[this.n++] = symbol;
        continue;
      }
      if (symbol === END_OF_BLOCK) return;
      require(symbol - 257 < LENGTH_BASE.length, "deflate: no such length");
      const length = LENGTH_BASE[symbol - 257] + this.bits(LENGTH_BITS[symbol - 257]);
      const code = this.symbol(distances);
      require(code < DISTANCE_BASE.length, "deflate: no such distance");
      const distance = DISTANCE_BASE[code] + this.bits(DISTANCE_BITS[code]);
      require(distance <= this.n, "deflate: distance reaches too far back");
      this.reserve(length);
      const out = this.out;
      for (let to = this.n, end = to + length; to < end; to++) out[to] = out[to - distance];
      this.n += length;
    }
  }

  /** Inflate all blocks; return the bytes, without the dictionary's. */
  run() {
    for (let isLast = 0; !isLast; ) {
      isLast = this.bits(1);
      const kind = this.bits(2);
      require(kind < 3, "deflate: no such kind of block");
      if (kind === 0) this.stored();
      else this.compressed(kind === 1 ? fixed() : this.readTables());
    }
    this.at -= this.nHeld >> 3;
    return this.out.subarray(this.nBefore, this.n);
  }
}

function adler32(bytes) {
  let a = 1;
  let b = 0;
  for (let i = 0; i < bytes.length; ) {
    for (const end = Math.min(i + 3800, bytes.length); i < end; i++) b += a += bytes[i];
    a %= 65521;
    b %= 65521;
  }
  return b * 65536 + a;
}

const NOTHING = new Uint8Array(0);

/** Inflate one zlib stream that fills `data` exactly, to at most `limit` bytes. */
export function inflateZlib(data, limit) {
  require(data.length >= 2, "deflated section ends early");
  require((data[0] & 15) === 8 && data[0] >> 4 <= 7 && (data[0] * 256 + data[1]) % 31 === 0,
    "header of a zlib stream");
  require((data[1] & 32) === 0, "zlib stream with a dictionary");
  const inflater = new Inflater(data.subarray(2), limit, NOTHING);
  const content = inflater.run();
  const at = 2 + inflater.at;
  require(at + 4 <= data.length, "deflated section ends early");
  require(at + 4 === data.length, "bytes after a deflated section");
  const sum = ((data[at] * 256 + data[at + 1]) * 256 + data[at + 2]) * 256 + data[at + 3];
  require(sum === adler32(content), "Adler-32 of a zlib stream");
  return content;
}

/** Inflate one raw stream that fills `data` exactly and may refer back to `dictionary`. */
export function inflateRaw(data, limit, dictionary = NOTHING) {
  const inflater = new Inflater(data, limit, dictionary);
  const content = inflater.run();
  require(inflater.at === data.length, "bytes after a deflated section");
  return content;
}
