/** Tables of a file of method rapid: stencils, weights of features, frequencies (R.10). */

import { bitLength } from "./bytes.js";
import { require, requireKnown } from "./errors.js";
import { HAS_REACH, HAS_WEIGHTS } from "./header.js";
import { CODES, FEATURES, STENCILS } from "./rapid-data.js";
import { Models, RangeDecoder } from "./rangecoder.js";
import { magnitudeReader, readChangedStencil, unpackedTable } from "./stencils.js";

export const N_CONTEXTS = 176;
export const N_SYMBOLS = 63;
export const SLOT_BITS = 11;
const TOTAL = 1 << SLOT_BITS;
const N_FAMILIES = 6; // of contexts by the mean, and as many by reach
const MEAN = 1, REACH = 3, WEIGHTS = 5; // layouts: contexts by the mean, by reach; weights
const N_CLASSES = 4;
const MOST_CODE = 127;
const WEIGHTS_GROUP = 8; // of magnitudes: weights of features
const OWN = 9 * 46; // the first model of flags
const WEIGHT_SHIFTS = [14, 7, 7, 7, 13, 13, 9, 7, 7];
/** Codes of weights that those of the finest class are changes of, by plane HH, HL, LH. */
const USUAL_WEIGHTS = [
  [12, 58, 50, 25, 33, 35, 57, 0, 0],
  [4, 39, 37, 10, 25, 24, 37, 49, 32],
  [4, 35, 19, 18, 22, 22, 35, 48, 23],
];
/** How large a sum of features can be, in units of the largest range: by plane, then feature. */
const MOST_FEATURES = [
  [0, 8, 16, 8, 1, 1, 4, 0, 0],
  [0, 8, 16, 8, 1, 1, 2, 16, 32],
  [0, 8, 16, 8, 1, 1, 2, 48, 32],
];

/** Indices among the taps of a stencil, by plane HH, HL, LH: those of the core, c_1 first (R.6). */
const CORE_TAPS = [[5, 6, 9, 10], [1, 2, 9, 12], [1, 2, 12, 13]];

let allCodes = null;

/** Return the codes of a family of contexts by the mean or by reach, by context and symbol. */
function codesOf(isByReach, family) {
  if (allCodes === null) allCodes = unpackedTable(CODES, 2 * N_FAMILIES * N_CONTEXTS * N_SYMBOLS);
  const n = N_CONTEXTS * N_SYMBOLS;
  const first = ((isByReach ? N_FAMILIES : 0) + family) * n;
  return allCodes.subarray(first, first + n);
}

function valueOfCode(g) {
  if (g < 32) return g;
  const e = ((g - 32) >> 4) + 1;
  return ((16 + (g % 16)) << e) + (1 << (e - 1));
}

/** Return the first symbol with the greatest code of the annex. */
function restOf(trained, context) {
  let rest = 0;
  for (let s = 1; s < N_SYMBOLS; s++) {
    if (trained[context * N_SYMBOLS + s] > trained[context * N_SYMBOLS + rest]) rest = s;
  }
  return rest;
}

/**
 * Return what decodes symbols: by context and slot the symbol, by context and symbol its frequency
 * and, shifted by 12, the sum of those before.
 */
function decodingTables(codes, trained) {
  const slots = new Uint8Array(N_CONTEXTS * TOTAL);
  const frequencies = new Int32Array(N_CONTEXTS * 64);
  for (let context = 0; context < N_CONTEXTS; context++) {
    const rest = restOf(trained, context);
    const found = new Int32Array(N_SYMBOLS);
    let others = 0;
    for (let s = 0; s < N_SYMBOLS; s++) {
      if (s === rest) continue;
      found[s] = valueOfCode(codes[context * N_SYMBOLS + s]);
      others += found[s];
    }
    found[rest] = TOTAL - others;
    require(found[rest] >= 1 && found[0] >= 1, "frequencies of a context");
    for (let s = 0, sum = 0; s < N_SYMBOLS; s++) {
      frequencies[context * 64 + s] = found[s] | (sum << 12);
      slots.fill(s, context * TOTAL + sum, context * TOTAL + sum + found[s]);
      sum += found[s];
    }
  }
  return { slots, frequencies };
}

function readStencil(decoder, magnitude, plane) {
  const set = decoder.raw(4);
  require(set < STENCILS[plane].length, "set of stencils");
  const trained = STENCILS[plane][set];
  if (decoder.raw(1) === 0) return trained.slice();
  return readChangedStencil(trained, CORE_TAPS[plane], decoder, magnitude);
}

function readCodes(decoder, magnitude, models, trained) {
  const codes = Int32Array.from(trained);
  let isOwn = 0;
  for (let context = 0; context < N_CONTEXTS; context++) {
    isOwn = decoder.bit(models, OWN + isOwn);
    if (!isOwn) continue;
    const rest = restOf(trained, context);
    let before = 0;
    for (let s = 0; s < N_SYMBOLS; s++) {
      if (s === rest) continue;
      const g = trained[context * N_SYMBOLS + s];
      before = magnitude((g ? 5 : 2) + Math.min(bitLength(before), 2), MOST_CODE);
      const isLess = before > 0 && g > 0 && decoder.raw(1);
      const code = isLess ? g - before : g + before;
      require(code >= 0 && code <= MOST_CODE, "code of a frequency");
      codes[context * N_SYMBOLS + s] = code;
    }
  }
  return codes;
}

/** Return the weights of features of the finest classes, by class, plane and feature. */
function readWeights(decoder, magnitude, nClasses) {
  let codes = USUAL_WEIGHTS;
  return Array.from({ length: nClasses }, () => {
    codes = codes.map((usual, plane) => usual.map((code, k) => {
      if (k > 0 && MOST_FEATURES[plane][k] === 0) return 0;
      const change = magnitude(WEIGHTS_GROUP, MOST_CODE);
      const found = change > 0 && decoder.raw(1) ? code - change : code + change;
      require(found >= 0 && found <= MOST_CODE, "code of a weight");
      return found;
    }));
    return codes.map((row, plane) => {
      const weights = row.map((code, k) => valueOfCode(code) * 2 ** WEIGHT_SHIFTS[k]);
      const most = weights.reduce((sum, weight, k) => sum + weight * MOST_FEATURES[plane][k], 0);
      require(most < 2 ** 24 - 2 ** 15, "weights of features");
      return weights;
    });
  });
}

/** Return { kMax, stencils[class][plane], features[class][row], slots, frequencies, widest, isByReach }. */
export function readRapidTables(parameters, header) {
  let family = header.step === 1 ? 0 : header.step === 3 ? 1 : 2;
  let isByReach = false;
  let kMax = 0;
  let weights = [];
  let stencils;
  let codes;
  const layout = parameters.length === 0 ? MEAN : parameters[0];
  require(!(header.features & HAS_REACH) || layout === REACH, "tables that are not by reach");
  const isTold = (header.features & HAS_WEIGHTS) !== 0;
  require(isTold === (layout === WEIGHTS), "weights that the header does not tell, or no weights");
  if (parameters.length === 0) {
    stencils = Array.from({ length: N_CLASSES }, () => STENCILS.map((sets) => sets[0]));
    codes = codesOf(isByReach, family);
  } else {
    requireKnown([MEAN, REACH, WEIGHTS].includes(layout), `layout ${layout} of the parameters`);
    const decoder = new RangeDecoder(parameters.subarray(1));
    const models = new Models(OWN + 2);
    const magnitude = magnitudeReader(decoder, models);
    kMax = decoder.raw(5);
    family = decoder.raw(3);
    require(family < N_FAMILIES, "family of frequencies");
    isByReach = layout === WEIGHTS ? decoder.raw(1) === 1 : layout === REACH;
    const nClasses = layout === WEIGHTS ? decoder.raw(2) + 1 : 0;
    stencils = Array.from({ length: N_CLASSES }, () =>
      STENCILS.map((_, plane) => readStencil(decoder, magnitude, plane)),
    );
    weights = readWeights(decoder, magnitude, nClasses);
    codes = readCodes(decoder, magnitude, models, codesOf(isByReach, family));
    decoder.end();
  }
  const sums = stencils.flat().map((one) => one.reduce((sum, w) => sum + Math.abs(w), 0));
  const table = FEATURES[Math.floor(family / 3)];
  return {
    kMax, stencils,
    features: table.map((rows, which) =>
      rows.map((row, plane) => scaledFeatures(weights[which]?.[plane] ?? row, header.step))),
    widest: Math.max(...sums),
    isByReach,
    ...decodingTables(codes, codesOf(isByReach, family)),
  };
}

/** Features of ranges are counted in 2^r quanta, those of errors in 2^lg(n) (R.7). */
export function rangeShift(step) {
  return Math.max(bitLength(step) - 5, 0);
}

/** Return the nine weights of a row of the table for the step of the file (R.7). */
function scaledFeatures(weights, step) {
  const shifts = { 0: 0, 4: rangeShift(step), 5: rangeShift(step), 6: rangeShift(step) };
  return Int32Array.from(weights, (weight, k) => {
    const shift = BigInt(shifts[k] ?? bitLength(step) - 1);
    const quotient = (BigInt(weight) << shift) / BigInt(k === 0 ? 1 : step);
    return Number((quotient + 128n) >> 8n);
  });
}
