/**
 * Rows of the planes of a lattice: what is predicted, and in which context (R.6, R.7).
 *
 * All planes of a lattice have the same layout: sample [i, j] of each is at
 * (i + MARGIN) · stride + MARGIN + j. Heights are less than the unit's origin, so that every sum
 * here fits 32 bits; where it would not, rapid-wide.js does the same in doubles. The predictors
 * name their taps one by one, as arrays of weights would be read again for each sample.
 */

export const MARGIN = 4;
export const [HH, HL, LH] = [0, 1, 2];
export const MOST_ERROR = 2 ** 18 - 1;
/** Set in a context where the detail counts downwards. */
export const DOWN = 256;
const MOST_FAR = 2 ** 20 - 1;
const { abs, clz32, imul, max, min } = Math;

/** Arrays that units are decoded in, one after the other. */
export class Workspace {
  /** `Numbers`: Int32Array, or Float64Array for heights that need more (R.2, wide). */
  constructor(Numbers, nRows, nCols) {
    this.Numbers = Numbers;
    this.resize(nRows, nCols);
  }

  resize(nRows, nCols) {
    const { Numbers } = this;
    this.size = (nRows + 2 * MARGIN + 1) * (nCols + 2 * MARGIN + 1);
    this.coarse = new Numbers(this.size);
    this.planes = [0, 1, 2].map(() => new Numbers(this.size));
    this.errors = [0, 1, 2].map(() => new Int32Array(this.size));
    this.bends = new Int32Array(this.size);
    this.nMost = max(nCols, nRows, 64) + 2 * MARGIN + 1;
    this.predicted = new Numbers(this.nMost); // in 1/64 quanta
    this.least = new Numbers(this.nMost); // of the core
    this.most = new Numbers(this.nMost);
    this.sum = new Numbers(this.nMost);
    this.twist = new Numbers(this.nMost);
    this.line = new Numbers(this.nMost);
    this.lineOf = new Numbers(this.nMost);
    this.expected = new Int32Array(this.nMost);
    this.whole = new Int32Array(this.nMost);
    this.contexts = new Int32Array(this.nMost);
    this.details = new Numbers(this.nMost);
    this.valid = new Uint8Array(this.nMost);
    this.result = new Int32Array(this.nMost);
  }

  /** Take a unit: rows and columns of plane A, validity of the region. */
  take(nRows, nCols, valid) {
    this.reserve(nRows, nCols);
    this.heights = new Int32Array(valid.length);
    this.regionValid = valid;
    this.nHeights = valid.length;
  }

  /** Make room for a lattice whose plane A has so many rows and columns. */
  reserve(nRows, nCols) {
    const isLarge = (nRows + 2 * MARGIN + 1) * (nCols + 2 * MARGIN + 1) > this.size;
    if (isLarge || max(nRows, nCols) + 2 * MARGIN + 1 > this.nMost) {
      this.resize(max(nRows, this.nMost - 9), max(nCols, this.nMost - 9));
    }
    this.stride = nCols + 2 * MARGIN + 1;
  }
}

/** Predict a row of HH, HL or LH: fill predicted, least, most, sum, twist; begin expected. */
export const predictRow = [predictHH, predictHL, predictLH];

function predictHH(m, first, n, weights, features) {
  const { stride, coarse, bends, predicted, least, most, sum, twist, expected } = m;
  const own = m.planes[HH];
  const errors = m.errors[HH];
  const w0 = weights[0], w1 = weights[1], w2 = weights[2], w3 = weights[3], w4 = weights[4],
    w5 = weights[5], w6 = weights[6], w7 = weights[7], w8 = weights[8], w9 = weights[9],
    w10 = weights[10], w11 = weights[11], w12 = weights[12], w13 = weights[13],
    w14 = weights[14], w15 = weights[15], w16 = weights[16], w17 = weights[17],
    w18 = weights[18];
  const north = features[1], diagonal = features[2], north2 = features[3], bend = features[6];
  for (let j = 0; j < n; j++) {
    const i = first + j;
    const up = i - stride;
    const down = i + stride;
    const low = down + stride;
    const a = coarse[i];
    const b = coarse[i + 1];
    const c = coarse[down];
    const d = coarse[down + 1];
    let p = 32 + imul(w0, coarse[up - 1]) + imul(w1, coarse[up]);
    p = (p + imul(w2, coarse[up + 1]) + imul(w3, coarse[up + 2])) | 0;
    p = (p + imul(w4, coarse[i - 1]) + imul(w5, a)) | 0;
    p = (p + imul(w6, b) + imul(w7, coarse[i + 2])) | 0;
    p = (p + imul(w8, coarse[down - 1]) + imul(w9, c)) | 0;
    p = (p + imul(w10, d) + imul(w11, coarse[down + 2])) | 0;
    p = (p + imul(w12, coarse[low - 1]) + imul(w13, coarse[low])) | 0;
    p = (p + imul(w14, coarse[low + 1]) + imul(w15, coarse[low + 2])) | 0;
    p = (p + imul(w16, own[up - 1]) + imul(w17, own[up])) | 0;
    p = (p + imul(w18, own[up + 1])) | 0;
    predicted[j] = p >> 6;
    least[j] = min(min(a, b), min(c, d));
    most[j] = max(max(a, b), max(c, d));
    sum[j] = (((a + b) | 0) + ((c + d) | 0)) | 0;
    twist[j] = abs((((a + d) | 0) - ((b + c) | 0)) | 0);
    let e = imul(north, errors[up]) + imul(diagonal, (errors[up - 1] + errors[up + 1]) | 0);
    e = (e + imul(north2, errors[up - stride])) | 0;
    const bent = (bends[i] + bends[i + 1] + bends[down] + bends[down + 1]) | 0;
    expected[j] = (e + imul(bend, bent)) | 0;
  }
}

function predictHL(m, first, n, weights, features) {
  const { stride, coarse, bends, predicted, least, most, sum, twist, expected } = m;
  const [hh, own] = m.planes;
  const [errorsHH, errors] = m.errors;
  const w0 = weights[0], w1 = weights[1], w2 = weights[2], w3 = weights[3], w4 = weights[4],
    w5 = weights[5], w6 = weights[6], w7 = weights[7], w8 = weights[8], w9 = weights[9],
    w10 = weights[10], w11 = weights[11], w12 = weights[12], w13 = weights[13],
    w14 = weights[14], w15 = weights[15], w16 = weights[16], w17 = weights[17],
    w18 = weights[18];
  const north = features[1], diagonal = features[2], north2 = features[3], bend = features[6];
  const near = features[7], far = features[8];
  for (let j = 0; j < n; j++) {
    const i = first + j;
    const up = i - stride;
    const down = i + stride;
    const a = coarse[i];
    const b = coarse[i + 1];
    const c = hh[up];
    const d = hh[i];
    let p = 32 + imul(w0, coarse[i - 1]) + imul(w1, a);
    p = (p + imul(w2, b) + imul(w3, coarse[i + 2])) | 0;
    p = (p + imul(w4, coarse[up]) + imul(w5, coarse[up + 1])) | 0;
    p = (p + imul(w6, coarse[down]) + imul(w7, coarse[down + 1])) | 0;
    p = (p + imul(w8, hh[up - 1]) + imul(w9, c)) | 0;
    p = (p + imul(w10, hh[up + 1]) + imul(w11, hh[i - 1])) | 0;
    p = (p + imul(w12, d) + imul(w13, hh[i + 1])) | 0;
    p = (p + imul(w14, hh[up - stride]) + imul(w15, hh[down])) | 0;
    p = (p + imul(w16, own[up - 1]) + imul(w17, own[up])) | 0;
    p = (p + imul(w18, own[up + 1])) | 0;
    predicted[j] = p >> 6;
    least[j] = min(min(a, b), min(c, d));
    most[j] = max(max(a, b), max(c, d));
    const across = (a + b) | 0;
    const along = (c + d) | 0;
    sum[j] = (across + along) | 0;
    twist[j] = abs((across - along) | 0);
    let e = imul(north, errors[up]) + imul(diagonal, (errors[up - 1] + errors[up + 1]) | 0);
    e = (e + imul(north2, errors[up - stride])) | 0;
    e = (e + imul(bend, (bends[i] + bends[i + 1]) | 0)) | 0;
    e = (e + imul(near, (errorsHH[up] + errorsHH[i]) | 0)) | 0;
    const beside = (errorsHH[up - 1] + errorsHH[i - 1] + errorsHH[up + 1] + errorsHH[i + 1]) | 0;
    expected[j] = (e + imul(far, beside)) | 0;
  }
}

function predictLH(m, first, n, weights, features) {
  const { stride, coarse, bends, predicted, least, most, sum, twist, expected } = m;
  const [hh, hl, own] = m.planes;
  const [errorsHH, errorsHL, errors] = m.errors;
  const w0 = weights[0], w1 = weights[1], w2 = weights[2], w3 = weights[3], w4 = weights[4],
    w5 = weights[5], w6 = weights[6], w7 = weights[7], w8 = weights[8], w9 = weights[9],
    w10 = weights[10], w11 = weights[11], w12 = weights[12], w13 = weights[13],
    w14 = weights[14], w15 = weights[15], w16 = weights[16], w17 = weights[17],
    w18 = weights[18], w19 = weights[19], w20 = weights[20], w21 = weights[21],
    w22 = weights[22];
  const north = features[1], diagonal = features[2], north2 = features[3], bend = features[6];
  const near = features[7], far = features[8];
  for (let j = 0; j < n; j++) {
    const i = first + j;
    const up = i - stride;
    const down = i + stride;
    const a = coarse[i];
    const b = coarse[down];
    const c = hh[i - 1];
    const d = hh[i];
    let p = 32 + imul(w0, coarse[up]) + imul(w1, a);
    p = (p + imul(w2, b) + imul(w3, coarse[down + stride])) | 0;
    p = (p + imul(w4, coarse[i - 1]) + imul(w5, coarse[i + 1])) | 0;
    p = (p + imul(w6, coarse[down - 1]) + imul(w7, coarse[down + 1])) | 0;
    p = (p + imul(w8, own[up - 1]) + imul(w9, own[up])) | 0;
    p = (p + imul(w10, own[up + 1]) + imul(w11, hh[i - 2])) | 0;
    p = (p + imul(w12, c) + imul(w13, d)) | 0;
    p = (p + imul(w14, hh[i + 1]) + imul(w15, hh[up - 1])) | 0;
    p = (p + imul(w16, hh[up]) + imul(w17, hh[down - 1])) | 0;
    p = (p + imul(w18, hh[down]) + imul(w19, hl[i - 1])) | 0;
    p = (p + imul(w20, hl[i]) + imul(w21, hl[down - 1])) | 0;
    p = (p + imul(w22, hl[down])) | 0;
    predicted[j] = p >> 6;
    least[j] = min(min(a, b), min(c, d));
    most[j] = max(max(a, b), max(c, d));
    const across = (a + b) | 0;
    const along = (c + d) | 0;
    sum[j] = (across + along) | 0;
    twist[j] = abs((across - along) | 0);
    let e = imul(north, errors[up]) + imul(diagonal, (errors[up - 1] + errors[up + 1]) | 0);
    e = (e + imul(north2, errors[up - stride])) | 0;
    e = (e + imul(bend, (bends[i] + bends[down]) | 0)) | 0;
    let beside = (errorsHH[i - 1] + errorsHH[i] + errorsHL[i - 1] + errorsHL[i]) | 0;
    beside = (beside + errorsHL[down - 1] + errorsHL[down]) | 0;
    e = (e + imul(near, beside)) | 0;
    beside = (errorsHH[up - 1] + errorsHH[up] + errorsHH[down - 1] + errorsHH[down]) | 0;
    expected[j] = (e + imul(far, beside)) | 0;
  }
}

/** Fill whole and contexts of a row; clamp predicted (R.6, R.7). */
export function fillContexts(m, n, features, scale) {
  const { predicted, least, most, sum, twist, expected, whole, contexts } = m;
  const { rangeShift, mostRange, isFine, isByReach, sideShift, sideScale, farScale, endShift } = scale;
  const ofConst = features[0], ofRange = features[4], ofTwist = features[5];
  for (let j = 0; j < n; j++) {
    const low = least[j];
    const high = most[j];
    const p = min(max(predicted[j], low << 6), high << 6);
    const w = (p + 32) >> 6;
    predicted[j] = p;
    whole[j] = w;
    let e = (expected[j] + ofConst) | 0;
    e = (e + imul(ofRange, min(((high - low) | 0) >> rangeShift, mostRange))) | 0;
    e = (e + imul(ofTwist, min(twist[j] >> rangeShift, mostRange))) >> 4;
    let bin = 0;
    if (e >= 32) {
      const log2 = 31 - clz32(e);
      bin = min(2 * log2 + ((e >> (log2 - 1)) & 1) - 10, 43);
    }
    let context = 4 * bin;
    let side = ((sum[j] << 4) - p) | 0;
    if (isFine && (bin < 16 || !isByReach)) {
      side = (p - (w << 6)) | 0;
      if (bin < 16) context += min(imul(abs(side), sideScale) >> 16, 3);
    } else {
      const far = !isByReach ? abs(side) : side < 0 ? ((high << 6) - p) | 0 : (p - (low << 6)) | 0;
      const x = imul(min(far >> sideShift, MOST_FAR), farScale) >> endShift;
      // 11 e and more may pass 2^31: as doubles it stays exact.
      if (isByReach) context += (x > 2 * e ? 1 : 0) + (x > 6 * e ? 1 : 0) + (x > 12 * e ? 1 : 0);
      else context += (x > e ? 1 : 0) + (4 * x > 11 * e ? 1 : 0) + (x > 6 * e ? 1 : 0);
    }
    contexts[j] = side < 0 ? context | DOWN : context;
  }
}

/**
 * Fill the heights first … stop - 1 of a row whose samples begin at `at`, and their errors; write
 * heights to every `step`-th place of the region too, that of sample 0 is `start`.
 */
export function finishRow(m, plane, at, first, stop, limits, scale, start, step) {
  const { predicted, whole, details, contexts, heights: out } = m;
  const own = m.planes[plane];
  const errors = m.errors[plane];
  const { low, high, origin } = limits;
  const { errorShift, step: quantum } = scale;
  for (let j = first, k = start + first * step; j < stop; j++, k += step) {
    const change = imul(details[j], quantum);
    const height = min(max((contexts[j] & DOWN ? whole[j] - change : whole[j] + change) | 0, low), high);
    own[at + j] = height;
    out[k] = height + origin;
    errors[at + j] = min(abs(((height << 6) - predicted[j]) | 0) >> errorShift, MOST_ERROR);
  }
}

/** Fill the errors of samples first … stop - 1 of a row that begins at `at` (R.6). */
export function noteErrors(m, plane, at, first, stop, scale) {
  const { predicted } = m;
  const heights = m.planes[plane];
  const errors = m.errors[plane];
  const { errorShift } = scale;
  for (let j = first; j < stop; j++) {
    const error = abs(((heights[at + j] << 6) - predicted[j]) | 0) >> errorShift;
    errors[at + j] = min(error, MOST_ERROR);
  }
}
