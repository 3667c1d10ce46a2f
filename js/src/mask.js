/** Masks (FORMAT.md §5.1, §5.2), and own samples (§5.4). */

import { require } from "./errors.js";
import { kernels } from "./kernels.js";
import { Models, RATES, RangeDecoder, learned } from "./rangecoder.js";

/** Start values of the models, in 1/256 (§5.2). */
// prettier-ignore
const STARTS = [
  17, 3, 9, 20, 6, 2, 20, 20, 6, 14, 6, 13, 34, 33, 1, 34, 34, 32, 19, 4, 43, 41, 8, 2,
  41, 41, 41, 19, 27, 84, 84, 79, 29, 84, 84, 84, 109, 22, 37, 101, 101, 18, 101, 101, 101, 46, 5, 11,
  61, 61, 5, 61, 61, 61, 96, 105, 119, 119, 119, 100, 119, 119, 119, 58, 77, 108, 108, 108, 82, 108, 108, 108,
  36, 37, 54, 105, 54, 15, 105, 105, 41, 14, 12, 12, 71, 56, 4, 71, 71, 22, 14, 17, 19, 88, 41, 6,
  88, 88, 33, 10, 8, 15, 73, 66, 7, 73, 73, 29, 94, 105, 126, 126, 126, 109, 126, 126, 126, 45, 56, 112,
  112, 112, 50, 112, 112, 112, 86, 126, 126, 126, 126, 126, 126, 126, 126, 46, 74, 113, 113, 113, 99, 113, 113, 113,
  129, 83, 123, 127, 127, 83, 127, 127, 127, 100, 50, 94, 121, 121, 42, 121, 121, 121, 123, 116, 128, 128, 128, 116,
  128, 128, 128, 110, 123, 127, 127, 127, 127, 127, 127, 127, 200, 126, 158, 158, 158, 78, 158, 158, 158, 218, 92, 138,
  201, 201, 67, 201, 201, 201, 177, 103, 132, 132, 132, 128, 132, 132, 132, 143, 90, 132, 132, 132, 113, 132, 132, 132,
  93, 71, 69, 123, 123, 55, 123, 123, 123, 34, 22, 24, 84, 78, 6, 84, 84, 34, 51, 63, 110, 124, 124, 101,
  124, 124, 124, 19, 10, 30, 88, 88, 15, 88, 88, 41, 136, 49, 126, 126, 126, 65, 126, 126, 126, 129, 74, 153,
  119, 119, 41, 119, 119, 119, 89, 73, 124, 124, 124, 110, 124, 124, 124, 87, 29, 99, 94, 94, 24, 94, 94, 94,
  211, 139, 161, 165, 130, 122, 165, 165, 165, 191, 157, 136, 136, 136, 136, 136, 136, 136, 222, 115, 204, 210, 131, 90,
  210, 210, 210, 170, 121, 134, 148, 147, 105, 148, 148, 148, 247, 162, 166, 166, 166, 166, 166, 166, 166, 224, 147, 140,
  140, 140, 140, 140, 140, 140, 236, 173, 193, 193, 193, 193, 193, 193, 193, 204, 150, 159, 159, 159, 155, 159, 159, 159,
  180, 114, 121, 132, 114, 105, 132, 132, 132, 144, 95, 133, 129, 129, 114, 129, 129, 129, 187, 105, 122, 161, 133, 31,
  161, 161, 144, 134, 30, 69, 124, 132, 27, 124, 124, 85, 187, 122, 129, 129, 129, 129, 129, 129, 129, 148, 117, 128,
  128, 128, 128, 128, 128, 128, 211, 168, 162, 162, 162, 162, 162, 162, 162, 153, 119, 136, 136, 136, 110, 136, 136, 136,
  229, 140, 132, 132, 132, 132, 132, 132, 132, 192, 122, 130, 130, 130, 130, 130, 130, 130, 227, 134, 140, 140, 140, 140,
  140, 140, 140, 195, 127, 132, 132, 132, 132, 132, 132, 132, 253, 179, 178, 178, 178, 178, 178, 178, 178, 252, 201, 190,
  190, 190, 190, 190, 190, 190, 252, 200, 203, 203, 203, 203, 203, 203, 203, 239, 178, 198, 198, 198, 198, 198, 198, 198,
  231, 166, 136, 137, 137, 137, 137, 137, 137, 202, 128, 141, 140, 140, 132, 140, 140, 140, 245, 213, 209, 213, 227, 226,
  213, 213, 213, 233, 163, 159, 221, 223, 172, 221, 221, 175, 248, 198, 159, 159, 159, 159, 159, 159, 159, 254, 244, 245,
  245, 245, 249, 245, 245, 245, 255, 239, 247, 247, 247, 247, 247, 247, 247, 255, 253, 255, 255, 255, 255, 255, 255, 255,
];
const MODELS = Int32Array.from(STARTS, (s) => ((16 * s) << 4) | 1); // as `Models` takes them

/** Return 1 where a void sample of the parent heights touches a sample of the region, else 0. */
function impliedVoid(unit, parent) {
  const { rows, cols } = unit;
  const implied = new Uint8Array(rows.n * cols.n);
  if (parent === null || !parent.hasVoid) return implied;
  const [above, below] = touching(rows, parent.rows);
  const [left, right] = touching(cols, parent.cols);
  for (let r = 0; r < rows.n; r++) {
    const first = parent.base + above[r] * parent.stride;
    const second = parent.base + below[r] * parent.stride;
    implyRow(parent.valid, first, second, left, right, implied, r * cols.n);
  }
  return implied;
}

function implyRow(valid, first, second, left, right, implied, to) {
  for (let c = 0; c < left.length; c++) {
    const [i, j] = [left[c], right[c]];
    implied[to + c] = (valid[first + i] & valid[first + j] & valid[second + i] & valid[second + j]) ^ 1;
  }
}

/** Return the parent's lines at or before and at or after each line of an axis. */
function touching(axis, parentAxis) {
  const inside = (place) =>
    Math.min(Math.max(place, parentAxis.first), parentAxis.last) - parentAxis.first;
  const before = new Int32Array(axis.n);
  const after = new Int32Array(axis.n);
  for (let i = 0; i < axis.n; i++) {
    before[i] = inside((axis.first + i) >>> 1);
    after[i] = inside((axis.first + i + 1) >>> 1);
  }
  return [before, after];
}

/** Return the validity of all samples of a unit that has a mask, 1 or 0. */
export function decodeMask(section, unit, parent) {
  const { rows, cols } = unit;
  if (kernels.masks) return decodeByKernels(section, unit, parent);
  const implied = impliedVoid(unit, parent);
  // Two samples of margin on each side stand for what lies outside the region.
  const stride = cols.n + 4;
  const valid = new Uint8Array((rows.n + 4) * stride);
  const isImplied = new Uint8Array((rows.n + 4) * stride);
  for (let r = 0; r < rows.n; r++) {
    isImplied.set(implied.subarray(r * cols.n, (r + 1) * cols.n), (r + 2) * stride + 2);
  }
  const decoder = new RangeDecoder(section);
  const models = new Models(MODELS.length, MODELS);
  for (let r = 0; r < rows.n; r++) {
    const at = (r + 2) * stride + 2;
    decodeRow(decoder, models, valid, isImplied, at, at + cols.n, stride);
  }
  decoder.end();
  return withoutMargin(valid, rows.n, cols.n);
}

function withoutMargin(valid, nRows, nCols) {
  const inside = new Uint8Array(nRows * nCols);
  for (let r = 0; r < nRows; r++) {
    const at = (r + 2) * (nCols + 4) + 2;
    inside.set(valid.subarray(at, at + nCols), r * nCols);
  }
  return inside;
}

/** Return the validity of all samples of a unit without a mask: those not implied are valid. */
export function unmasked(unit, parent) {
  const { rows, cols } = unit;
  const valid = new Uint8Array(rows.n * cols.n).fill(1);
  if (parent === null || !parent.hasVoid) return valid;
  const implied = impliedVoid(unit, parent);
  for (let i = 0; i < valid.length; i++) valid[i] = implied[i] ^ 1;
  return valid;
}

/** What is known of a sample before a map is read (§5.4). */
const [UNKNOWN, NO, YES] = [0, 1, 2];
const N_MAP_MODELS = 1296;

/**
 * Return { valid, own } of a unit of a file that tells fills; own is null where it is the same.
 *
 * Sections are null where there are none. On the finest level there is no section of own samples.
 */
export function decodeValidity(mask, own, unit, parent, isFinest) {
  const { rows, cols } = unit;
  const implied = impliedVoid(unit, parent);
  const known = knownOfOwn(unit, parent, implied);
  if (isFinest) return { valid: decodeMap(mask, known, rows.n, cols.n), own: null };
  const found = decodeMap(own, known, rows.n, cols.n);
  const valid = decodeMap(mask, knownOfMask(implied, found, rows.n, cols.n), rows.n, cols.n);
  return { valid, own: valid.every((bit, i) => bit === found[i]) ? null : found };
}

/** Voids that are implied, and on even rows and columns what the parent says. */
function knownOfOwn({ rows, cols }, parent, implied) {
  const known = Uint8Array.from(implied); // NO is 1
  if (parent === null) return known;
  const own = parent.own ?? parent.valid;
  for (let r = rows.first & 1; r < rows.n; r += 2) {
    const row = parent.base + (((rows.first + r) >>> 1) - parent.rows.first) * parent.stride;
    for (let c = cols.first & 1; c < cols.n; c += 2) {
      const col = ((cols.first + c) >>> 1) - parent.cols.first;
      known[r * cols.n + c] = own[row + col] ? YES : NO;
    }
  }
  return known;
}

/** Voids that are implied, and all beside own samples. */
function knownOfMask(implied, own, nRows, nCols) {
  const known = new Uint8Array(own.length);
  for (let r = 0, i = 0; r < nRows; r++) {
    for (let c = 0; c < nCols; c++, i++) {
      if (!own[i]) continue;
      for (let row = Math.max(r - 1, 0); row <= Math.min(r + 1, nRows - 1); row++) {
        for (let col = Math.max(c - 1, 0); col <= Math.min(c + 1, nCols - 1); col++) {
          known[row * nCols + col] = YES;
        }
      }
    }
  }
  for (let i = 0; i < known.length; i++) if (implied[i]) known[i] = NO;
  return known;
}

function decodeMap(section, known, nRows, nCols) {
  if (section === null) return known.map((what) => (what === NO ? 0 : 1));
  // A sample of margin on each side stands for what lies outside the region.
  const stride = nCols + 2;
  const bits = new Uint8Array((nRows + 2) * stride);
  const framed = new Uint8Array((nRows + 2) * stride);
  for (let r = 0; r < nRows; r++) {
    framed.set(known.subarray(r * nCols, (r + 1) * nCols), (r + 1) * stride + 1);
  }
  const decoder = new RangeDecoder(section);
  const models = new Models(N_MAP_MODELS);
  const found = new Uint8Array(nRows * nCols);
  for (let r = 0; r < nRows; r++) {
    for (let i = (r + 1) * stride + 1, end = i + nCols; i < end; i++) {
      if (framed[i] !== UNKNOWN) {
        bits[i] = framed[i] === YES ? 1 : 0;
        continue;
      }
      const before = 8 * bits[i - 1] + 4 * bits[i - stride] + 2 * bits[i - stride - 1] +
        bits[i - stride + 1];
      const ahead = 27 * framed[i + 1] + 9 * framed[i + stride] + 3 * framed[i + stride + 1] +
        framed[i + stride - 1];
      bits[i] = decoder.bit(models, 81 * before + ahead);
    }
    const from = (r + 1) * stride + 1;
    found.set(bits.subarray(from, from + nCols), r * nCols);
  }
  decoder.end();
  return found;
}

const START = new Models(MODELS.length, MODELS).cells;

/** The same by compiled kernels (js/wasm/masks.c). */
function decodeByKernels(section, unit, parent) {
  const { rows, cols } = unit;
  const stride = cols.n + 4;
  const n = (rows.n + 4) * stride;
  const nAbove = parent ? parent.rows.n * parent.cols.n : 0;
  const m = kernels.masks.arrange({
    cells: [Int32Array, START.length], rates: [Int32Array, RATES.length],
    above: [Int32Array, rows.n], below: [Int32Array, rows.n], left: [Int32Array, cols.n],
    right: [Int32Array, cols.n], parentValid: [Uint8Array, nAbove],
    both: [Uint8Array, parent ? parent.cols.n : 0], valid: [Uint8Array, n],
    implied: [Uint8Array, n], data: [Uint8Array, section.length],
  });
  m.valid.fill(0);
  m.implied.fill(0);
  if (parent?.hasVoid) {
    const [above, below] = touching(rows, parent.rows);
    const [left, right] = touching(cols, parent.cols);
    for (const [name, lines] of Object.entries({ above, below, left, right })) m[name].set(lines);
    for (let r = 0; r < parent.rows.n; r++) {
      const start = parent.base + r * parent.stride;
      m.parentValid.set(parent.valid.subarray(start, start + parent.cols.n), r * parent.cols.n);
    }
    kernels.masks.run.imply(rows.n, cols.n, m.parentValid.byteOffset, parent.cols.n,
      m.above.byteOffset, m.below.byteOffset, m.left.byteOffset, m.right.byteOffset,
      m.both.byteOffset, m.implied.byteOffset + 2 * stride + 2, stride);
  }
  m.cells.set(START);
  m.rates.set(RATES);
  m.data.set(section);
  const position = kernels.masks.run.decodeMask(rows.n, cols.n, stride, m.valid.byteOffset,
    m.implied.byteOffset, m.cells.byteOffset, m.rates.byteOffset, m.data.byteOffset,
    section.length);
  require(position - 3 === section.length, "a range coder stream has another length");
  return withoutMargin(m.valid, rows.n, cols.n);
}

/** What `RangeDecoder.bit` does, with all state in locals. */
function decodeRow(decoder, models, valid, isImplied, start, end, stride) {
  const { data, state } = decoder;
  const { cells } = models;
  let [range, code, position] = state;
  for (let i = start; i < end; i++) {
    if (isImplied[i] !== 0) continue;
    const near = 32 * valid[i - 1] + 16 * valid[i - stride] + 8 * valid[i - stride - 1] +
      4 * valid[i - stride + 1] + 2 * valid[i - 2] + valid[i - 2 * stride];
    const a = isImplied[i + stride] + isImplied[i + 1];
    const far = isImplied[i + 2] + isImplied[i + stride - 1] + isImplied[i + stride + 1] +
      isImplied[i + 2 * stride];
    const model = (near * 3 + a) * 3 + (far < 2 ? far : 2);
    const cell = cells[model];
    const bound = Math.imul(range >>> 16, (cell >>> 14) | 1);
    if (code >>> 0 < bound >>> 0) {
      range = bound;
      valid[i] = 1;
    } else {
      code = (code - bound) | 0;
      range = (range - bound) | 0;
    }
    cells[model] = learned(cell, valid[i]);
    while (range >>> 24 === 0) {
      code = (code << 8) | (position < data.length ? data[position] : 0);
      position++;
      range <<= 8;
    }
  }
  state.set([range, code, position]);
}
