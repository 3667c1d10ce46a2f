/** The streams of a payload of method rapid: symbols and raw bits (R.1, R.8, R.9). */

import { readVarint } from "./bytes.js";
import { require } from "./errors.js";
import { DOWN } from "./rapid-rows.js";
import { SLOT_BITS } from "./rapid-tables.js";

const CONTEXT = DOWN - 1;
const ZERO = 31; // the symbol of no detail
const ESCAPE = 0;
const FIRST_RAW = 72; // contexts from here on have raw bits
const START = 65536;
/** What counts are of: symbols, words and raw bits that were read. */
const [SYMBOLS, WORDS, BITS] = [0, 1, 2];

export class Streams {
  constructor(payload, tables) {
    require(payload.length > 0 && payload[0] < 4, "flags of rapid");
    this.isWide = (payload[0] & 1) !== 0;
    const nStates = payload[0] & 2 ? 1 : 8;
    const [nWords, start] = readVarint(payload, 1);
    const wordsAt = start + 4 * nStates;
    require(wordsAt + 2 * nWords <= payload.length, "states and words");
    this.states = new Int32Array(nStates);
    for (let i = 0, at = start; i < nStates; i++, at += 4) {
      this.states[i] =
        payload[at] | (payload[at + 1] << 8) | (payload[at + 2] << 16) | (payload[at + 3] << 24);
    }
    this.nWords = nWords;
    this.words = new Uint16Array(nWords + 1); // the last one, 0, stands for all beyond the end
    for (let i = 0, at = wordsAt; i < nWords; i++, at += 2) {
      this.words[i] = payload[at] | (payload[at + 1] << 8);
    }
    this.rawBytes = payload.subarray(wordsAt + 2 * nWords);
    this.tables = tables;
    this.counts = new Int32Array(3);
  }

  /** Let compiled kernels read on, in whose memory a workspace lies that took the streams. */
  moveTo(workspace) {
    this.states = workspace.allStates.subarray(0, this.states.length);
    this.counts = workspace.counts;
  }

  /**
   * Fill the details first … stop - 1 of a row, towards the side of their contexts.
   *
   * Samples that are not in `valid` (null: all are) have no symbol and the detail 0.
   */
  readDetails(m, first, stop, valid, mostDetail) {
    if (this.readSymbols(m.contexts, m.details, first, stop, valid)) {
      this.readRaw(m.contexts, m.details, first, stop, valid, mostDetail);
    }
  }

  /** Return whether any sample has raw bits. */
  readSymbols(contexts, details, first, stop, valid) {
    const { states, words, nWords, tables: { slots, frequencies } } = this;
    const last = states.length - 1;
    let [nSymbols, nWordsUsed] = this.counts;
    let hasRaw = false;
    for (let j = first; j < stop; j++) {
      if (valid !== null && valid[j] === 0) {
        details[j] = 0;
        continue;
      }
      const context = contexts[j] & CONTEXT;
      const x = states[nSymbols & last];
      const y = x & 2047;
      const symbol = slots[(context << SLOT_BITS) | y];
      const entry = frequencies[(context << 6) | symbol];
      const next = (Math.imul(entry & 4095, x >>> SLOT_BITS) + y - (entry >>> 12)) | 0;
      // Whether a word follows is hard to foresee: -1 if it does, else 0, and no branch.
      const takes = ((next >>> 16) - 1) >> 31;
      const word = words[Math.min(nWordsUsed, nWords)];
      states[nSymbols & last] = (next << (takes & 16)) | (word & takes);
      nWordsUsed -= takes;
      nSymbols++;
      details[j] = symbol - ZERO;
      if (symbol === ESCAPE || context >= FIRST_RAW) hasRaw = true;
    }
    this.counts[SYMBOLS] = nSymbols;
    this.counts[WORDS] = nWordsUsed;
    return hasRaw;
  }

  readRaw(contexts, details, first, stop, valid, mostDetail) {
    for (let j = first; j < stop; j++) {
      if (valid !== null && valid[j] === 0) continue;
      const n = Math.max(((contexts[j] & CONTEXT) >> 3) - 8, 0);
      let detail = details[j];
      if (detail === ESCAPE - ZERO) {
        const low = this.bits(24) + this.bits(8) * 2 ** 24;
        detail = low - this.bits(1) * 2 ** 32;
      } else if (n > 0) {
        detail = detail * (1 << n) + this.bits(n);
      } else {
        continue;
      }
      details[j] = Math.min(Math.max(detail, -mostDetail), mostDetail);
    }
  }

  /** Return the next n <= 24 raw bits, the first one lowest; 0 beyond the end. */
  bits(n) {
    const bytes = this.rawBytes;
    const used = this.counts[BITS];
    const at = used >>> 3;
    const shift = used & 7;
    this.counts[BITS] = used + n;
    if (at + 4 > bytes.length) return this.lastBits(at, shift, n);
    const held = bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16) | (bytes[at + 3] << 24);
    return (held >>> shift) & ((1 << n) - 1);
  }

  lastBits(at, shift, n) {
    let held = 0;
    for (let i = 0; i < 4; i++) {
      if (at + i < this.rawBytes.length) held |= this.rawBytes[at + i] << (8 * i);
    }
    return (held >>> shift) & ((1 << n) - 1);
  }

  end() {
    require(this.counts[WORDS] === this.nWords, "number of words");
    require(this.states.every((x) => x === START), "states at the end");
    require(Math.ceil(this.counts[BITS] / 8) === this.rawBytes.length, "number of raw bits");
    const nLeft = -this.counts[BITS] & 7;
    if (nLeft > 0) require(this.rawBytes.at(-1) >> (8 - nLeft) === 0, "filling of the raw bits");
  }
}
