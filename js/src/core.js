/** A file in an instance of the decoder (js/wasm/host.c): calls into it, and no waiting. */

import {
  ArgumentError, CorruptStreamError, LimitExceededError, TerrainwaveError, UnsupportedError,
} from "./errors.js";

/** By twz_status (native/include/terrainwave.h): what the decoder refuses. */
const REFUSALS = [
  null, CorruptStreamError, UnsupportedError, LimitExceededError, LimitExceededError, ArgumentError,
];
const NOT_READY = 6;
/** By name, and of each dtype and method its number (FORMAT.md §4.1). */
export const ARRAYS = {
  uint8: Uint8Array, uint16: Uint16Array, int16: Int16Array, int32: Int32Array,
  float32: Float32Array, float64: Float64Array,
};
const DTYPES = { 1: "uint8", 3: "uint16", 4: "int16", 6: "int32", 7: "float32", 8: "float64" };
const METHODS = ["store", "cdf97", "predictive", "cdf53", "rapid"];
/** Memory that is not for decoded units, of the 2 GiB that an instance may take. */
const MOST_OF_A_WINDOW = 2 ** 30;
const MOST_KEPT = 2 ** 29;
/** While a large window is read in parts: what is above the next ones. */
const KEPT_OF_PARTS = 2 ** 24;
/** Of rows that are copied out of the memory together: they fit caches of processors. */
const SAMPLES_AT_ONCE = 2 ** 17;
/** Memory that waits for another file: to get it from the system takes as long as to decode a small one. */
const MOST_SPARE = 2 ** 26;
/** Samples on a side of a tile that has a digest (FORMAT.md §4.9), at most. */
const SIDE_OF_DIGESTS = 512;
let spare = null; // what a decoder exports whose file was closed

/** Return the bytes of a range out of what came, { start, bytes } of each, or where what is missing begins. */
function find(held, start, end) {
  const parts = [];
  let at = start;
  while (at < end) {
    const one = held.find((piece) => piece.start <= at && at < piece.start + piece.bytes.length);
    if (!one) return { missing: at };
    parts.push(one.bytes.subarray(at - one.start, end - one.start));
    at += parts.at(-1).length;
  }
  if (parts.length === 1) return { bytes: parts[0] };
  const bytes = new Uint8Array(end - start);
  let n = 0;
  for (const part of parts) {
    bytes.set(part, n);
    n += part.length;
  }
  return { bytes };
}

export class Core {
  #exports;
  #array; // of heights
  #void; // what void samples hold
  #cacheBytes;

  /** True after the decoder broke off: its memory may hold anything. */
  isBroken = false;

  /** Begin a file of `size` bytes, of which `cacheBytes` of decoded units are kept. */
  static async start(module, size, cacheBytes) {
    const core = new Core();
    core.#exports = spare;
    spare = null;
    try {
      core.#exports ??= (await WebAssembly.instantiate(module)).exports;
    } catch (cause) {
      throw new LimitExceededError(`no memory for another decoder: ${cause.message}`, { cause });
    }
    core.#cacheBytes = Math.min(cacheBytes, MOST_KEPT);
    core.#do("begin_file", size, core.#cacheBytes, MOST_OF_A_WINDOW);
    return core;
  }

  /** Give the memory back; nothing can be called any more. */
  end() {
    if (this.#exports && !this.isBroken) {
      this.#call("end_file");
      if (this.#exports.memory.buffer.byteLength <= MOST_SPARE) spare = this.#exports;
    }
    this.#exports = null;
  }

  #call(name, ...args) {
    if (this.isBroken) throw new TerrainwaveError("the decoder broke off: read again");
    if (!this.#exports) throw new ArgumentError("the terrain is closed");
    try {
      return this.#exports[name](...args);
    } catch (cause) {
      this.isBroken = true;
      throw new CorruptStreamError(
        `the decoder broke off, and the file is to blame, or the decoder: ${cause.message}`, { cause },
      );
    }
  }

  /** Call a function that returns a status. */
  #do(name, ...args) {
    const status = this.#call(name, ...args);
    if (status !== 0) throw this.#refusal(status);
  }

  #refusal(status) {
    const text = this.#view(Uint8Array, this.#call("error_text"), 240);
    const Kind = REFUSALS[status] ?? TerrainwaveError;
    return new Kind(new TextDecoder().decode(text.subarray(0, text.indexOf(0))));
  }

  /** Return n numbers that the last call told. */
  #told(n) {
    return [...this.#view(Float64Array, this.#call("numbers"), n)];
  }

  /** Return numbers that lie in the memory, until another call. */
  #view(Type, at, n) {
    return new Type(this.#exports.memory.buffer, at, n);
  }

  /**
   * Feed what the `file` or the `window` needs next, of what is held. Return null if it was there,
   * else { start, end, isPage } of each range that is missing; none: nothing is needed.
   */
  #step(whom, held) {
    const n = this.#call(`${whom}_need`);
    if (n < 0) throw this.#refusal(-n);
    const told = this.#told(3 * n);
    const ranges = Array.from({ length: n }, (_, i) => {
      const [start, length, isPage] = told.slice(3 * i, 3 * i + 3);
      return { start, end: start + length, isPage: isPage === 1, ...find(held, start, start + length) };
    });
    const missing = ranges.filter(({ bytes }) => !bytes);
    // Pages of the index that are here may tell more of what is missing.
    const isTold = ranges.some(({ isPage, bytes }) => isPage && bytes);
    if (n === 0 || (missing.length > 0 && !isTold)) {
      return missing.map(({ missing: start, end, isPage }) => ({ start, end, isPage }));
    }
    for (const { start, bytes } of ranges) if (bytes) this.#feed(whom, start, bytes);
    return null;
  }

  #feedAll(whom, held) {
    for (;;) {
      const missing = this.#step(whom, held);
      if (missing) return missing;
    }
  }

  #feed(whom, start, bytes) {
    this.#give(bytes);
    this.#do(`feed_${whom}`, start, bytes.length);
  }

  /** Copy bytes into the memory, one after another. */
  #give(...parts) {
    const n = parts.reduce((sum, { byteLength }) => sum + byteLength, 0);
    let at = this.#call("room_for", n);
    if (at === 0) throw new LimitExceededError(`no memory for ${n} bytes`);
    for (const { buffer, byteOffset, byteLength } of parts) {
      this.#view(Uint8Array, at, byteLength).set(new Uint8Array(buffer, byteOffset, byteLength));
      at += byteLength;
    }
  }

  /** Return what is missing to open the file: nothing, and `describe` may be called. */
  open(held) {
    return this.#feedAll("file", held);
  }

  /** Return what the file says of itself. */
  describe() {
    this.#call("describe");
    const [nRows, nCols, nLevels, blockSize, dtype, , method, features, maxError, effectiveBound, hasNodata, nodata,
      text, length, rawMin, rawMax, rawRho, boundSide] = this.#told(18);
    this.#array = ARRAYS[DTYPES[dtype]];
    this.#void = hasNodata ? nodata : NaN; // 0 in an array of integers
    return {
      nRows, nCols, nLevels, blockSize, features, maxError, effectiveBound, rawMin, rawMax, rawRho, boundSide,
      dtype: DTYPES[dtype], method: METHODS[method],
      nodata: hasNodata ? nodata : null,
      metadata: new TextDecoder().decode(this.#view(Uint8Array, text, length)),
    };
  }

  /**
   * Return { missing } of a window; nothing, where all of it was there: then `take` was called with the
   * heights and validity of some rows, which it must copy, and the first of these rows, until there
   * were no more. Void samples hold nodata, NaN or 0; if `isExact`, fills are void.
   */
  read({ level, row, col, nRows, nCols, isExact, isPart }, held, take) {
    return this.#withWindow([level, row, col, nRows, nCols], () => {
      const missing = this.#feedAll("window", held);
      if (missing.length > 0) return { missing };
      // The units of a large window would drive out all others, and take memory that is slow to get.
      this.#call("limit_cache", isPart ? Math.min(this.#cacheBytes, KEPT_OF_PARTS) : this.#cacheBytes);
      this.#do("decode_window");
      const most = Math.max(Math.floor(SAMPLES_AT_ONCE / nCols), 1);
      for (let first = 0; first < nRows; first += most) {
        const rows = Math.min(most, nRows - first);
        this.#do("read_rows", first, rows, isExact ? 1 : 0);
        const n = rows * nCols;
        const [heights, valid, own] = this.#told(3).map((at, i) => this.#view(i ? Uint8Array : this.#array, at, n));
        for (let i = 0; isExact && i < n; i++) {
          if (valid[i] === own[i]) continue;
          valid[i] = own[i];
          heights[i] = this.#void;
        }
        take(heights, valid, first);
      }
      return {};
    });
  }

  /** Return { missing }, or { found }: the error of a block's surface, in raw units. */
  blockError({ level, row, col, blockSize }, held) {
    return this.#withWindow([level, row * blockSize, col * blockSize, 1, 1], () => {
      for (;;) {
        const status = this.#call("block_error", row, col);
        if (status === 0) return { found: this.#told(1)[0] };
        const missing = status === NOT_READY ? this.#step("window", held) : [];
        if (missing?.length === 0) throw this.#refusal(status);
        if (missing) return { missing: missing.filter(({ isPage }) => isPage) };
      }
    });
  }

  /** Return the digest of a tile of heights and their validity (FORMAT.md §4.9). */
  digest({ heights, valid, nRows, nCols }) {
    const isSide = (n) => Number.isInteger(n) && n > 0 && n <= SIDE_OF_DIGESTS;
    if (!isSide(nRows) || !isSide(nCols)) {
      throw new ArgumentError(`found a tile of ${nRows} x ${nCols} samples, expected 1 to ${SIDE_OF_DIGESTS} on each side`);
    }
    const kinds = { heights: [heights, this.#array], valid: [valid, Uint8Array] };
    for (const [name, [found, Kind]] of Object.entries(kinds)) {
      if (found instanceof Kind && found.length === nRows * nCols) continue;
      throw new ArgumentError(`found ${name} of ${found?.length} values (${found?.constructor.name}), expected a`
        + ` ${Kind.name} of ${nRows} x ${nCols}`);
    }
    this.#give(heights, valid);
    this.#do("digest_given", nRows, nCols);
    return this.#view(Uint8Array, this.#call("digest_at"), 32).slice();
  }

  /** Return the root of the digests of all tiles, row by row. */
  rootOf(digests) {
    if (!(digests instanceof Uint8Array)) throw new ArgumentError(`found digests ${digests}, expected a Uint8Array`);
    this.#give(digests);
    this.#do("root_of_given", digests.length);
    return this.#root();
  }

  /** Return { missing }, or { found }: the root that the file states, null without digests. */
  statedRoot(_, held) {
    let n = this.#call("digests_need");
    if (n === 0) return { found: null };
    for (const next of ["top_need", "root_of_top_given"]) {
      if (n < 0) throw this.#refusal(-n);
      const [start, length] = this.#told(2);
      const { missing, bytes } = find(held, start, start + length);
      if (!bytes) return { missing: [{ start: missing, end: start + length, isPage: false }] };
      this.#give(bytes);
      n = this.#call(next);
    }
    return { found: this.#root() };
  }

  #root() {
    return new TextDecoder().decode(this.#view(Uint8Array, this.#call("root_at"), 64));
  }

  #withWindow(place, use) {
    this.#do("begin_window", ...place);
    try {
      return use();
    } finally {
      if (!this.isBroken) this.#call("end_window");
    }
  }
}
