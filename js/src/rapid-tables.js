/** Tables of a file of method rapid: stencils, weights of features, frequencies (R.10). */

import { bitLength } from "./bytes.js";
import { require, requireKnown } from "./errors.js";
import { HAS_REACH } from "./header.js";
import { CODES, FEATURES, STENCILS } from "./rapid-data.js";
import { Models, RangeDecoder } from "./rangecoder.js";
import { magnitudeReader, readChangedStencil, unpackedTable } from "./stencils.js";

export const N_CONTEXTS = 176;
export const N_SYMBOLS = 63;
export const SLOT_BITS = 11;
const TOTAL = 1 << SLOT_BITS;
const N_FAMILIES = 6; // of each layout
const REACH = 3;
const LAYOUTS = [1, REACH]; // contexts by the mean, by reach
const N_CLASSES = 4;
const MOST_CODE = 127;

/** Indices among the taps of a stencil, by plane HH, HL, LH: those of the core, c_1 first (R.6). */
const CORE_TAPS = [[5, 6, 9, 10], [1, 2, 9, 12], [1, 2, 12, 13]];

let allCodes = null;

/** Return the codes of a family of a layout, by context and symbol. */
function codesOf(layout, family) {
  if (allCodes === null) {
    allCodes = unpackedTable(CODES, LAYOUTS.length * N_FAMILIES * N_CONTEXTS * N_SYMBOLS);
  }
  const n = N_CONTEXTS * N_SYMBOLS;
  const first = (layout * N_FAMILIES + family) * n;
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
    isOwn = decoder.bit(models, 368 + isOwn);
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

/** Return { kMax, stencils[class][plane], features[class][row], slots, frequencies, widest, isByReach }. */
export function readRapidTables(parameters, header) {
  let family = header.step === 1 ? 0 : header.step === 3 ? 1 : 2;
  let layout = 0;
  let kMax = 0;
  let stencils;
  let codes;
  const isTold = (header.features & HAS_REACH) !== 0;
  require(!isTold || parameters[0] === REACH, "tables that are not by reach");
  if (parameters.length === 0) {
    stencils = Array.from({ length: N_CLASSES }, () => STENCILS.map((sets) => sets[0]));
    codes = codesOf(layout, family);
  } else {
    layout = LAYOUTS.indexOf(parameters[0]);
    requireKnown(layout >= 0, `layout ${parameters[0]} of the parameters`);
    const decoder = new RangeDecoder(parameters.subarray(1));
    const models = new Models(370);
    const magnitude = magnitudeReader(decoder, models);
    kMax = decoder.raw(5);
    family = decoder.raw(3);
    require(family < N_FAMILIES, "family of frequencies");
    stencils = Array.from({ length: N_CLASSES }, () =>
      STENCILS.map((_, plane) => readStencil(decoder, magnitude, plane)),
    );
    codes = readCodes(decoder, magnitude, models, codesOf(layout, family));
    decoder.end();
  }
  const sums = stencils.flat().map((one) => one.reduce((sum, w) => sum + Math.abs(w), 0));
  const table = FEATURES[Math.floor(family / 3)];
  return {
    kMax, stencils,
    features: table.map((rows) => rows.map((row) => scaledFeatures(row, header.step))),
    widest: Math.max(...sums),
    isByReach: layout === 1,
    ...decodingTables(codes, codesOf(layout, family)),
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
