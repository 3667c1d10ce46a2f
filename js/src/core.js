/** A file in an instance of the decoder (js/wasm/host.c): calls into it, and no waiting. */

import {
  ArgumentError, CorruptStreamError, LimitExceededError, TerrainwaveError, UnsupportedError,
} from "./errors.js";

/** By twz_status (native/include/terrainwave.h): what the decoder refuses. */
const REFUSALS = [
  null, CorruptStreamError, UnsupportedError, LimitExceededError, LimitExceededError, ArgumentError,
];
const NOT_READY = 6;
/** By number, of FORMAT.md §4.1. */
const ARRAYS = {
  1: Uint8Array, 3: Uint16Array, 4: Int16Array, 6: Int32Array, 7: Float32Array, 8: Float64Array,
};
const METHODS = ["store", "cdf97", "predictive", "cdf53", "rapid"];
/** Memory that is not for decoded units, of the 2 GiB that an instance may take. */
const MOST_OF_A_WINDOW = 2 ** 30;
const MOST_KEPT = 2 ** 29;

/** Bytes of a file that came: { start, bytes } of each. */
function find(held, start, length) {
  const found = held.find((one) => one.start <= start && start + length <= one.start + one.bytes.length);
  return found?.bytes.subarray(start - found.start, start - found.start + length);
}

export class Core {
  #exports;
  #array; // of heights

  /** Whether the decoder broke off: what lies in its memory may be anything. */
  isBroken = false;

  /** Begin a file of `size` bytes, of which `cacheBytes` of decoded units are kept. */
  static async start(module, size, cacheBytes) {
    const core = new Core();
    try {
      core.#exports = (await WebAssembly.instantiate(module)).exports;
    } catch (cause) {
      throw new LimitExceededError(`no memory for another decoder: ${cause.message}`, { cause });
    }
    core.#do("begin_file", size, Math.min(cacheBytes, MOST_KEPT), MOST_OF_A_WINDOW);
    return core;
  }

  #call(name, ...args) {
    if (this.isBroken) throw new TerrainwaveError("the decoder broke off: read again");
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
    const text = new Uint8Array(this.#exports.memory.buffer, this.#call("error_text"), 240);
    const Kind = REFUSALS[status] ?? TerrainwaveError;
    return new Kind(new TextDecoder().decode(text.subarray(0, text.indexOf(0))));
  }

  /** Return n numbers that the last call told. */
  #told(n) {
    return [...new Float64Array(this.#exports.memory.buffer, this.#call("numbers"), n)];
  }

  /** Return a copy of bytes of the memory. */
  #copy(Type, at, n) {
    return new Type(this.#exports.memory.buffer, at, n).slice();
  }

  /**
   * Feed what the `file` or the `window` needs next, of what is held. Return null if it was there,
   * else { start, end, likely } of each range that is missing; none: nothing is needed.
   */
  #step(whom, held) {
    const n = this.#call(`${whom}_need`);
    if (n < 0) throw this.#refusal(-n);
    const told = this.#told(3 * n);
    const ranges = Array.from({ length: n }, (_, i) => told.slice(3 * i, 3 * i + 3));
    const parts = ranges.map(([start, length]) => find(held, start, length));
    const missing = ranges.filter((_, i) => !parts[i]);
    if (n === 0 || missing.length > 0) {
      return missing.map(([start, length, likely]) => ({ start, end: start + length, likely }));
    }
    parts.forEach((bytes, i) => this.#feed(whom, ranges[i][0], bytes));
    return null;
  }

  #feedAll(whom, held) {
    for (;;) {
      const missing = this.#step(whom, held);
      if (missing) return missing;
    }
  }

  #feed(whom, start, bytes) {
    const at = this.#call("room_for", bytes.length);
    if (at === 0) throw new LimitExceededError(`no memory for ${bytes.length} bytes of the file`);
    new Uint8Array(this.#exports.memory.buffer, at, bytes.length).set(bytes);
    this.#do(`feed_${whom}`, start, bytes.length);
  }

  /** Return what is missing to open the file: nothing, and `describe` may be called. */
  open(held) {
    return this.#feedAll("file", held);
  }

  /** Return what the file says of itself. */
  describe() {
    this.#call("describe");
    const [nRows, nCols, nLevels, blockSize, dtype, , method, features, maxError, effectiveBound, hasNodata, nodata,
      text, length] = this.#told(14);
    this.#array = ARRAYS[dtype];
    return {
      nRows, nCols, nLevels, blockSize, features, maxError, effectiveBound,
      dtype: this.#array.name.slice(0, -5).toLowerCase(), method: METHODS[method],
      nodata: hasNodata ? nodata : null,
      metadata: new TextDecoder().decode(this.#copy(Uint8Array, text, length)),
    };
  }

  /**
   * Return { missing } of a window, or { heights, valid } of all of it, row by row; void samples
   * hold nodata, NaN or 0, and if `isExact`, fills are void.
   */
  read({ level, row, col, nRows, nCols, isExact }, held) {
    return this.#withWindow([level, row, col, nRows, nCols], () => {
      const missing = this.#feedAll("window", held);
      if (missing.length > 0) return { missing };
      this.#do("read_window", isExact ? 1 : 0);
      const [heights, valid] = this.#told(2);
      const n = nRows * nCols;
      return { heights: this.#copy(this.#array, heights, n), valid: this.#copy(Uint8Array, valid, n) };
    });
  }

  /** Return { missing }, or { error }: of a block's surface, in raw units. */
  blockError({ level, row, col, blockSize }, held) {
    return this.#withWindow([level, row * blockSize, col * blockSize, 1, 1], () => {
      for (;;) {
        const status = this.#call("block_error", row, col);
        if (status === 0) return { error: this.#told(1)[0] };
        const missing = status === NOT_READY ? this.#step("window", held) : [];
        if (missing?.length === 0) throw this.#refusal(status);
        if (missing) return { missing };
      }
    });
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
