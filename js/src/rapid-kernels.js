/** What rapid-rows.js does, by compiled kernels: the arrays lie in their memory. */

import { kernels } from "./kernels.js";
import { HH, HL, LH, MARGIN, noteErrors } from "./rapid-rows.js";
import { N_CONTEXTS, SLOT_BITS } from "./rapid-tables.js";

/** In the order of TAKE_ROW in js/wasm/rapid.c and what follows there. */
const ROWS = [
  "predicted", "least", "most", "sum", "twist", "expected", "whole", "contexts", "details",
];
const PLANES = ["planeHH", "planeHL", "planeLH"];
const ERRORS = ["errorsHH", "errorsHL", "errorsLH"];

/** As `Workspace` of rapid-rows.js, with the words of a payload and the tables of a file besides. */
export class KernelWorkspace {
  constructor(nRows, nCols) {
    this.nWordsMost = 0;
    this.resize(nRows, nCols, 2 ** 16);
  }

  resize(nRows, nCols, nWords) {
    this.nRowsMost = nRows;
    this.nColsMost = nCols;
    this.nWordsMost = nWords;
    this.size = (nRows + 2 * MARGIN + 1) * (nCols + 2 * MARGIN + 1);
    this.nMost = Math.max(nCols, nRows, 64) + 2 * MARGIN + 1;
    const plane = [Int32Array, this.size];
    const layout = { coarse: plane, bends: plane, row: [Int32Array, ROWS.length * this.nMost] };
    for (const name of [...PLANES, ...ERRORS]) layout[name] = plane;
    Object.assign(this, kernels.rapid.arrange({
      ...layout, weights: [Int32Array, 24], features: [Int32Array, 9], used: [Int32Array, 2],
      allStates: [Int32Array, 8], valid: [Uint8Array, this.nMost], words: [Uint16Array, nWords + 1],
      slots: [Uint8Array, N_CONTEXTS << SLOT_BITS], frequencies: [Int32Array, N_CONTEXTS << 6],
    }));
    ROWS.forEach((name, i) => {
      this[name] = this.row.subarray(i * this.nMost, (i + 1) * this.nMost);
    });
    this.planes = PLANES.map((name) => this[name]);
    this.errors = ERRORS.map((name) => this[name]);
    this.tables = null;
    for (const name of ["line", "lineOf", "result"]) this[name] = new Int32Array(this.nMost);
  }

  reserve(nRows, nCols) {
    const isLarge = (nRows + 2 * MARGIN + 1) * (nCols + 2 * MARGIN + 1) > this.size;
    if (isLarge || Math.max(nRows, nCols) + 2 * MARGIN + 1 > this.nMost) {
      this.resize(Math.max(nRows, this.nRowsMost), Math.max(nCols, this.nColsMost), this.nWordsMost);
    }
    this.stride = nCols + 2 * MARGIN + 1;
  }

  /** Take what symbols are read from, of a unit; return its states. */
  takeStreams(words, states, tables) {
    if (words.length > this.words.length) {
      this.resize(this.nRowsMost, this.nColsMost, 2 * words.length);
    }
    if (this.tables !== tables) {
      this.slots.set(tables.slots);
      this.frequencies.set(tables.frequencies);
      this.tables = tables;
    }
    this.words.set(words);
    this.used.fill(0);
    const held = this.allStates.subarray(0, states.length);
    held.set(states);
    return held;
  }
}

const place = (array, at) => array.byteOffset + 4 * at;

function take(m, weights, features) {
  m.weights.set(weights);
  m.features.set(features);
}

function predictHH(m, first, n, weights, features) {
  take(m, weights, features);
  kernels.rapid.run.predictHH(n, m.stride, place(m.coarse, first), place(m.planes[HH], first),
    place(m.errors[HH], first), place(m.bends, first), m.weights.byteOffset, m.features.byteOffset,
    m.row.byteOffset, m.nMost);
}

function predictHL(m, first, n, weights, features) {
  take(m, weights, features);
  kernels.rapid.run.predictHL(n, m.stride, place(m.coarse, first), place(m.planes[HH], first),
    place(m.planes[HL], first), place(m.errors[HH], first), place(m.errors[HL], first),
    place(m.bends, first), m.weights.byteOffset, m.features.byteOffset, m.row.byteOffset, m.nMost);
}

function predictLH(m, first, n, weights, features) {
  take(m, weights, features);
  kernels.rapid.run.predictLH(n, m.stride, place(m.coarse, first), place(m.planes[HH], first),
    place(m.planes[HL], first), place(m.planes[LH], first), place(m.errors[HH], first),
    place(m.errors[HL], first), place(m.errors[LH], first), place(m.bends, first),
    m.weights.byteOffset, m.features.byteOffset, m.row.byteOffset, m.nMost);
}

export const predictRow = [predictHH, predictHL, predictLH];

/** Fill curvatures of a row of plane A. */
export function fillBends(m, first, n, shift, mostRange) {
  kernels.rapid.run.fillBends(n, m.stride, place(m.coarse, first), place(m.bends, first), shift,
    mostRange);
}

export function fillContexts(m, n, features, scale) {
  m.features.set(features);
  kernels.rapid.run.fillContexts(n, m.features.byteOffset, m.row.byteOffset, m.nMost,
    scale.rangeShift, scale.mostRange, scale.isFine ? 1 : 0, scale.sideShift, scale.sideScale,
    scale.endShift);
}

/** Read the symbols of a row; return whether any has raw bits. */
export function readSymbols(m, nStates, nWords, first, stop, hasVoid) {
  return kernels.rapid.run.readSymbols(first, stop, m.row.byteOffset, m.nMost,
    hasVoid ? m.valid.byteOffset : 0, m.slots.byteOffset, m.frequencies.byteOffset,
    m.allStates.byteOffset, nStates - 1, m.words.byteOffset, nWords, m.used.byteOffset) !== 0;
}

export function finishRow(m, plane, at, first, stop, limits, scale, out, start, step) {
  const { low, high, origin } = limits;
  const own = m.planes[plane];
  kernels.rapid.run.finishRow(first, stop, m.row.byteOffset, m.nMost, place(own, at),
    place(m.errors[plane], at), low, high, scale.step, scale.errorShift);
  for (let j = first, k = start; j < stop; j++, k += step) out[k] = own[at + j] + origin;
}

export { noteErrors };
