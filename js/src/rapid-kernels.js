/**
 * What rapid-rows.js and rapid-wide.js do, by compiled kernels: the arrays lie in their memory, and
 * so do the heights and the validity of the region that is decoded.
 */

import { kernels } from "./kernels.js";
import { HH, HL, LH, MARGIN } from "./rapid-rows.js";
import * as narrow from "./rapid-rows.js";
import { N_CONTEXTS, SLOT_BITS } from "./rapid-tables.js";
import * as wide from "./rapid-wide.js";

/** In the order of TAKE_ROW and TAKE_CODED in js/wasm/rapid-rows.h: sums of heights, and 32 bits. */
const SUMS = ["predicted", "sum", "twist", "details"];
const ROWS = ["least", "most", "expected", "whole", "contexts"];
const PLANES = ["planeHH", "planeHL", "planeLH"];
const ERRORS = ["errorsHH", "errorsHL", "errorsLH"];
const PAST_RAW = 4; // zeros behind the raw bits

const place = (array, at) => array.byteOffset + 4 * at;

/** As `Workspace` of rapid-rows.js, with what a unit's symbols are read from besides. */
class KernelWorkspace {
  constructor(name, Numbers) {
    Object.assign(this, { name, Numbers });
    this.room = { nRows: 257, nCols: 257, nHeights: 0, nWords: 2 ** 16, nRaw: 0 };
    this.arrange();
  }

  arrange() {
    const { room, Numbers } = this;
    this.size = (room.nRows + 2 * MARGIN + 1) * (room.nCols + 2 * MARGIN + 1);
    const n = Math.max(room.nCols, room.nRows, 64) + 2 * MARGIN + 1;
    this.nMost = n + (n & 1); // what follows lies at a multiple of 8 bytes
    const plane = [Int32Array, this.size];
    const layout = {
      sums: [Numbers, SUMS.length * this.nMost], rows: [Int32Array, ROWS.length * this.nMost],
      coarse: plane, bends: plane,
    };
    for (const name of [...PLANES, ...ERRORS]) layout[name] = plane;
    Object.assign(this, kernels[this.name].arrange({
      ...layout, weights: [Int32Array, 24], features: [Int32Array, 9], counts: [Int32Array, 3],
      allStates: [Int32Array, 8], heights: [Int32Array, room.nHeights],
      words: [Uint16Array, room.nWords + 1], raw: [Uint8Array, room.nRaw + PAST_RAW],
      slots: [Uint8Array, N_CONTEXTS << SLOT_BITS], frequencies: [Int32Array, N_CONTEXTS << 6],
      regionValid: [Uint8Array, room.nHeights], valid: [Uint8Array, this.nMost],
    }));
    const parts = (array, names) => names.forEach((name, i) => {
      this[name] = array.subarray(i * this.nMost, (i + 1) * this.nMost);
    });
    parts(this.sums, SUMS);
    parts(this.rows, ROWS);
    this.row = this.sums.byteOffset;
    this.planes = PLANES.map((name) => this[name]);
    this.errors = ERRORS.map((name) => this[name]);
    this.tables = null;
    for (const name of ["line", "lineOf"]) this[name] = new Numbers(this.nMost);
    this.result = new Int32Array(this.nMost);
  }

  /** Take a unit: rows and columns of plane A, validity of the region, streams, tables. */
  take(nRows, nCols, valid, streams) {
    const { words, rawBytes, states, tables } = streams;
    const needed = {
      nRows, nCols, nHeights: valid.length, nWords: words.length, nRaw: rawBytes.length,
    };
    if (Object.keys(needed).some((name) => needed[name] > this.room[name])) {
      for (const name in needed) this.room[name] = Math.max(this.room[name], needed[name]);
      this.arrange();
    }
    if (this.tables !== tables) {
      this.slots.set(tables.slots);
      this.frequencies.set(tables.frequencies);
      this.tables = tables;
    }
    this.words.set(words);
    this.raw.set(rawBytes);
    this.raw.fill(0, rawBytes.length, rawBytes.length + PAST_RAW);
    this.regionValid.set(valid);
    this.counts.fill(0);
    this.allStates.set(states);
    this.nStates = states.length;
    this.nWords = words.length - 1;
    this.nRaw = rawBytes.length;
    this.nHeights = valid.length;
    this.reserve(nRows, nCols);
  }

  /** Lay planes out for a lattice whose plane A has so many columns: never more than were taken. */
  reserve(nRows, nCols) {
    this.stride = nCols + 2 * MARGIN + 1;
  }
}

/** Arithmetic for units that are wide (R.2), or those that are not. */
class KernelArithmetic {
  constructor(name, suffix, Numbers, { noteErrors }) {
    Object.assign(this, { name, Numbers, noteErrors });
    const predicting = ["predictHH", "predictHL", "predictLH"];
    this.predictRow = predicting.map((predict) => this[predict].bind(this));
    const kernelsOf = [...predicting, "fillBends", "fillContexts", "readDetails", "finishRow"];
    this.names = Object.fromEntries(kernelsOf.map((kernel) => [kernel, kernel + suffix]));
  }

  makeWorkspace() {
    return new KernelWorkspace(this.name, this.Numbers);
  }

  // Called for every row: no arrays of arguments here.

  get run() {
    return kernels[this.name].run;
  }

  predictHH(m, first, n, weights, features) {
    m.weights.set(weights);
    m.features.set(features);
    this.run[this.names.predictHH](n, m.stride, place(m.coarse, first), place(m.planes[HH], first),
      place(m.errors[HH], first), place(m.bends, first), m.weights.byteOffset, m.features.byteOffset,
      m.row, m.nMost);
  }

  predictHL(m, first, n, weights, features) {
    m.weights.set(weights);
    m.features.set(features);
    this.run[this.names.predictHL](n, m.stride, place(m.coarse, first), place(m.planes[HH], first),
      place(m.planes[HL], first), place(m.errors[HH], first), place(m.errors[HL], first),
      place(m.bends, first), m.weights.byteOffset, m.features.byteOffset, m.row, m.nMost);
  }

  predictLH(m, first, n, weights, features) {
    m.weights.set(weights);
    m.features.set(features);
    this.run[this.names.predictLH](n, m.stride, place(m.coarse, first), place(m.planes[HH], first),
      place(m.planes[HL], first), place(m.planes[LH], first), place(m.errors[HH], first),
      place(m.errors[HL], first), place(m.errors[LH], first), place(m.bends, first),
      m.weights.byteOffset, m.features.byteOffset, m.row, m.nMost);
  }

  /** Fill curvatures of a row of plane A. */
  fillBends(m, first, n, shift, mostRange) {
    this.run[this.names.fillBends](n, m.stride, place(m.coarse, first), place(m.bends, first), shift,
      mostRange);
  }

  fillContexts(m, n, features, scale) {
    m.features.set(features);
    this.run[this.names.fillContexts](n, m.features.byteOffset, m.row, m.nMost, scale.rangeShift,
      scale.mostRange, scale.isFine ? 1 : 0, scale.isByReach ? 1 : 0, scale.sideShift, scale.sideScale,
      scale.farScale, scale.endShift);
  }

  /** Read the details of a row; of each, its validity is at every `step`-th place from `valid` on. */
  readDetails(m, first, stop, valid, step, mostDetail) {
    this.run[this.names.readDetails](first, stop, m.row, m.nMost, valid, step, m.slots.byteOffset,
      m.frequencies.byteOffset, m.allStates.byteOffset, m.nStates - 1, m.words.byteOffset, m.nWords,
      m.raw.byteOffset, m.nRaw, mostDetail, m.counts.byteOffset);
  }

  /** As in rapid-rows.js; `start` is that of the row's sample 0, of the heights of the region. */
  finishRow(m, plane, at, first, stop, { low, high, origin }, scale, start, step) {
    this.run[this.names.finishRow](first, stop, m.row, m.nMost, place(m.planes[plane], at),
      place(m.errors[plane], at), low, high, scale.step, scale.errorShift, place(m.heights, start),
      step, origin);
  }

  storeRow(m, n, from, start, step, origin) {
    this.run.storeRow(n, place(m.coarse, from), place(m.heights, start), step, origin);
  }
}

export const compiledNarrow = new KernelArithmetic("rapid", "", Int32Array, narrow);
export const compiledWide = new KernelArithmetic("rapidWide", "Wide", Float64Array, wide);
