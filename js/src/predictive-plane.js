/**
 * One plane of a lattice of method predictive (P.5 … P.7).
 *
 * What does not depend on the sample before is computed for a row at once, in loops that engines
 * make fast; the rest is one loop over samples, whose numbers are all locals. Numbers that may need
 * more than 32 bits are whole doubles below 2^53.
 */

import { corrected } from "./corrections.js";
import { lg, meanBit, power } from "./predictive-bits.js";
import { HH, HL, PARITY } from "./predictive-lattice.js";

const OWN = [[0, -2], [-2, 0], [-2, -2], [-2, 2]];
// prettier-ignore
const AFTER_OWN = [
  [0, -1], [0, 1], [0, -3], [0, 3], [-1, 0], [1, 0], [-1, -2], [-1, 2], [1, -2], [1, 2],
  [-2, -1], [-2, 1], [2, -1], [2, 1], [-3, 0], [3, 0],
];
const ODD = [-3, -1, 1, 3];
const DIAGONAL = [[-1, -1], [-1, 1], [1, -1], [1, 1]];
const turned = (places) => places.map(([r, c]) => [c, r]);

/** Places [row, column] in lattice steps from the sample that is predicted, by plane (P.5). */
export const PLACES = [
  { taps: [...OWN, ...ODD.flatMap((r) => ODD.map((c) => [r, c]))], core: DIAGONAL },
  { taps: [...OWN, ...AFTER_OWN], core: [[0, -1], [0, 1], [-1, 0], [1, 0]] },
  { taps: [...OWN, ...turned(AFTER_OWN), ...DIAGONAL], core: [[-1, 0], [1, 0], [0, -1], [0, 1]] },
];

/** |second difference| of a line of four, 2 · step apart (P.6, feature 13). */
const bend = (v, at, step) =>
  Math.abs(v[at - 3 * step] - v[at - step] - v[at + step] + v[at + 3 * step]);

/** What a row is computed in: 0 … nCols - 1 are its samples. */
class Row {
  constructor(n) {
    this.sum = new Float64Array(n); // of the stencil, but the tap at W
    this.c1 = new Float64Array(n); // the sorted core
    this.c2 = new Float64Array(n);
    this.c3 = new Float64Array(n);
    this.c4 = new Float64Array(n);
    this.total = new Float64Array(n); // of features, but those at W and WW
    this.distance = new Float64Array(n); // D, but what depends on P
  }
}

export class PlaneDecoder {
  constructor(lattice, plane, stencil, weights, unit) {
    Object.assign(this, { lattice, plane, ...unit });
    const { pitch } = lattice;
    const offsets = (places) => Int32Array.from(places, ([r, c]) => r * pitch + c);
    this.stencil = Float64Array.from(stencil);
    this.weights = Float64Array.from(weights);
    this.taps = offsets(PLACES[plane].taps);
    this.core = offsets(PLACES[plane].core);
    [this.down, this.right] = PARITY[plane];
    this.nRows = (lattice.nRows + 1 - this.down) >> 1;
    this.nCols = (lattice.nCols + 1 - this.right) >> 1;
    // Errors of this plane with two samples before each row and one after; two rows above.
    this.pitch = this.nCols + 3;
    this.errors = new Int32Array((this.nRows + 2) * this.pitch);
    this.row = new Row(this.nCols);
    this.ahead = new Int32Array(6);
  }

  run() {
    this.surroundFirstRow();
    for (let i = 0; i < this.nRows; i++) {
      const { errors, pitch, lattice: { values } } = this;
      const start = (i + 2) * pitch + 2;
      errors[start - 1] = errors[start - 2] = i > 0 ? errors[start - pitch] : 0;
      const first = this.at(i, 0);
      const last = this.at(i, this.nCols - 1);
      values[first - 2] = this.coreMean(first);
      values[last + 2] = this.coreMean(last);
      this.fillSums(first);
      this.fillCore(first);
      this.fillTotals(first, start, i === 0);
      this.fillDistances(first);
      this.decodeRow(i, first, start);
      errors[start + this.nCols] = errors[start + this.nCols - 1];
      this.fillActivity(i);
    }
    this.lattice.surround(PARITY[this.plane]);
  }

  at(i, j) {
    return this.lattice.at(2 * i + this.down, 2 * j + this.right);
  }

  coreMean(at) {
    const { core, lattice: { values } } = this;
    const sum = values[at + core[0]] + values[at + core[1]] + values[at + core[2]] + values[at + core[3]];
    return Math.floor((sum + 2) / 4);
  }

  /** Above the first row there are core means of its samples. */
  surroundFirstRow() {
    const { values, pitch } = this.lattice;
    for (let j = 0; j < this.nCols; j++) {
      values[this.at(0, j) - 2 * pitch] = this.coreMean(this.at(0, j));
    }
    const [first, last] = [this.at(0, 0), this.at(0, this.nCols - 1)];
    values[first - 2 * pitch - 2] = this.coreMean(first);
    values[last - 2 * pitch + 2] = this.coreMean(last);
  }

  /** Fill the stencils' sums: taps come four at a time, the first, at W, is left out. */
  fillSums(first) {
    const { taps, stencil, lattice: { values }, row: { sum }, nCols } = this;
    sum.fill(32);
    for (let k = 0; k < taps.length; k += 4) {
      const a = k === 0 ? 0 : stencil[k];
      const b = stencil[k + 1];
      const c = stencil[k + 2];
      const d = stencil[k + 3];
      const at = first + taps[k];
      const toB = taps[k + 1] - taps[k];
      const toC = taps[k + 2] - taps[k];
      const toD = taps[k + 3] - taps[k];
      for (let j = 0, i = at; j < nCols; j++, i += 2) {
        sum[j] += a * values[i] + b * values[i + toB] + c * values[i + toC] + d * values[i + toD];
      }
    }
  }

  fillCore(first) {
    const { core, lattice: { values }, row: { c1, c2, c3, c4 }, nCols } = this;
    const [toA, toB, toC, toD] = core;
    for (let j = 0, i = first; j < nCols; j++, i += 2) {
      const a = values[i + toA];
      const b = values[i + toB];
      const c = values[i + toC];
      const d = values[i + toD];
      const low = Math.min(a, b);
      const high = Math.max(a, b);
      const least = Math.min(c, d);
      const most = Math.max(c, d);
      const one = Math.max(low, least);
      const two = Math.min(high, most);
      c1[j] = Math.min(low, least);
      c2[j] = Math.min(one, two);
      c3[j] = Math.max(one, two);
      c4[j] = Math.max(high, most);
    }
  }

  /** Fill what the errors and activities known before the row add to E (P.6). */
  fillTotals(first, start, isFirst) {
    const { plane, weights: w, errors: own, pitch: up, lattice, row: { total }, nCols } = this;
    const { errors: e, activity: v, pitch } = lattice;
    const [w2, w3, w4, w5, w6, w7] = w.subarray(2, 8);
    const w15 = w[15];
    const w16 = isFirst ? 0 : w[16];
    const w17 = w[17];
    for (let j = 0, i = first, k = start; j < nCols; j++, i += 2, k++) {
      total[j] = w15 + w2 * own[k - up] + w3 * own[k - up - 1] + w4 * own[k - up + 1] +
        w5 * own[k - 2 * up] + w16 * v[i - 2 * pitch];
    }
    if (plane === HH) return;
    if (plane === HL) {
      for (let j = 0, i = first; j < nCols; j++, i += 2) {
        const [above, below] = [i - pitch, i + pitch];
        total[j] += w6 * (e[above] + e[below]) + w17 * v[below] +
          w7 * (e[above - 2] + e[above + 2] + e[below - 2] + e[below + 2]);
      }
      return;
    }
    for (let j = 0, i = first; j < nCols; j++, i += 2) {
      const [above, below] = [i - pitch, i + pitch];
      const near = e[i - 1] + e[i + 1] + e[above - 1] + e[above + 1] + e[below - 1] + e[below + 1];
      const far = e[above - pitch - 1] + e[above - pitch + 1] + e[below + pitch - 1] +
        e[below + pitch + 1];
      total[j] += w6 * near + w7 * far + w17 * (v[i + 1] + v[below + 1]);
    }
  }

  /** Fill what D has of the samples around (P.6). */
  fillDistances(first) {
    const { plane, weights, core, lattice, row: { c1, c4, distance }, nCols } = this;
    const { values: v, bends, pitch } = lattice;
    const [toA, toB, toC, toD] = core;
    const [w8, w9, w12, w13] = [8, 9, 12, 13].map((k) => weights[k]);
    const beside = plane === HL ? 1 : pitch;
    for (let j = 0, i = first; j < nCols; j++, i += 2) {
      const [a, b, c, d] = [v[i + toA], v[i + toB], v[i + toC], v[i + toD]];
      let bent;
      let lines;
      let twist;
      if (plane === HH) {
        bent = bends[i + toA] + bends[i + toB] + bends[i + toC] + bends[i + toD];
        twist = Math.abs(a + d - b - c);
        lines = bend(v, i - pitch, 1) + bend(v, i + pitch, 1) + bend(v, i - 1, pitch) +
          bend(v, i + 1, pitch);
      } else {
        bent = bends[i - beside] + bends[i + beside];
        twist = Math.abs(a + b - c - d);
        lines = bend(v, i, 1) + bend(v, i, pitch);
      }
      distance[j] = 64 * (w8 * bent + w9 * (c4[j] - c1[j]) + w12 * twist + w13 * lines);
    }
  }

  decodeRow(i, first, start) {
    const { lattice, stencil, weights, errors, step, scale, zMin, zMax, known, valid, row, corrections } = this;
    const { heights, values, pitch, errors: allErrors } = lattice;
    const { sum, total, distance } = row;
    const ofWest = stencil[0];
    const w0 = weights[0], w1 = weights[1], w10 = weights[10], w11 = weights[11], w14 = weights[14];
    const toNext = 2 * lattice.stride;
    let place = lattice.place(2 * i + this.down, this.right);
    for (let j = 0; j < this.nCols; j++, place += toNext) {
      const at = first + 2 * j;
      const c1 = row.c1[j];
      const c2 = row.c2[j];
      const c3 = row.c3[j];
      const c4 = row.c4[j];
      const west = values[at - 2];
      let p = Math.floor((sum[j] + ofWest * west) / 64);
      const off = Math.abs(p - 16 * (c1 + c2 + c3 + c4));
      if (this.isClamped) p = Math.min(Math.max(p, 64 * c1), 64 * c4);
      p = Math.min(Math.max(p, 64 * zMin), 64 * zMax);
      const w = Math.floor((p + 32) / 64);
      const isKnown = known[place] !== 0;
      const isValid = valid[place] !== 0;
      let height = w;
      if (isKnown) {
        height = heights[place];
      } else if (isValid) {
        const inner = 32 * (c2 + c3) - p;
        const outer = 32 * (c1 + c4) - p;
        const d = distance[j] + w10 * Math.abs(inner) + w11 * Math.abs(outer) + w14 * off;
        const sums = total[j] + w0 * errors[start + j - 1] + w1 * errors[start + j - 2];
        const e = Math.min(Math.floor((sums + scale.steps(d, -1)) / 64), 2 ** 28 - 1) | 0;
        const q = this.decodeDetail(e, p, w, c1, c2, c3, c4, west, values[at - 2 * pitch]);
        height = Math.min(Math.max(w + q * step, zMin), zMax);
      }
      if (!isKnown) height = corrected(corrections, place, height, zMin, zMax);
      heights[place] = height;
      values[at] = height;
      const error = isValid || isKnown ? Math.min(scale.steps(Math.abs(64 * height - p), -1), 32767) : 0;
      errors[start + j] = error;
      allErrors[at] = error;
    }
  }

  /** Fill the activity of a row (P.6). */
  fillActivity(i) {
    const { errors, pitch, nCols, lattice: { activity, pitch: stride } } = this;
    const first = this.at(i, 0);
    const e = (i + 2) * pitch + 2;
    for (let j = 0; j < nCols; j++) {
      let u = 0;
      if (i > 0) {
        const above = first + 2 * j - 2 * stride;
        const left = j > 0 ? activity[above - 2] : activity[above];
        const right = j < nCols - 1 ? activity[above + 2] : activity[above];
        u = left + 2 * activity[above] + right;
      }
      activity[first + 2 * j] = errors[e + j - 1] + 2 * errors[e + j] + errors[e + j + 1] + ((3 * u) >> 4);
    }
  }

  /** Read a bit B|H of models b and h (P.1). */
  bit(b, h) {
    return meanBit(this.decoder, this.models.cells, b, this.isMixed ? h : b);
  }

  mixedBit(b, h, mixer) {
    return this.isMixed
      ? this.mixers.bit(this.decoder, this.models.cells, b, h, mixer)
      : meanBit(this.decoder, this.models.cells, b, b);
  }

  /** Return the detail q (P.7). */
  decodeDetail(e, p, w, c1, c2, c3, c4, west, north) {
    const { scale, step } = this;
    const half = (step - 1) / 2;
    const phi = p - 64 * w;
    const beta = Math.min(Math.max(((lg(e) - 24) >> 2) + 1, 0), 43);
    const above = w + half;
    const below = w - half;
    const up = (c1 > above ? 1 : 0) + (c2 > above ? 1 : 0) + (c3 > above ? 1 : 0) +
      (c4 > above ? 1 : 0) + (west > above ? 1 : 0) + (north > above ? 1 : 0);
    const down = (c1 < below ? 1 : 0) + (c2 < below ? 1 : 0) + (c3 < below ? 1 : 0) +
      (c4 < below ? 1 : 0) + (west < below ? 1 : 0) + (north < below ? 1 : 0);
    const same = 6 - up - down;
    const range = rho(scale.steps(c4 - c1, 8), e);
    const side = Math.min(scale.steps(Math.abs(phi), -3), 3);
    const most = Math.min(up, down, 3);
    if (!this.bit(4 * (8 * beta + range) + side, 1408 + 4 * (7 * beta + same) + most)) return 0;
    const epsilon = beta < 7 ? 0 : beta < 10 ? 1 : beta < 13 ? 2 : beta < 16 ? 3 : 4;
    const slope = Math.min((scale.steps(6 * Math.abs(phi), -5) + 1) >> 1, 3);
    const sigma = phi > 0 ? 3 + slope : 3 - slope;
    const inner = mu(32 * (c2 + c3) - p, e, scale);
    const outer = mu(32 * (c1 + c4) - p, e, scale);
    const b = 2640 + 9 * (9 * (7 * epsilon + sigma) + inner) + outer;
    const isUp = this.mixedBit(b, 5475 + 8 * (8 * (beta >> 2) + up) + down, beta >> 2);
    const room = isUp ? 64 * c4 - p : p - 64 * c1;
    const reach = rho(scale.steps(Math.max(room, 0), 2), e);
    const sign = isUp ? 1 : -1;
    const { ahead } = this;
    const kappa = kappaOf(beta);
    ahead[0] = aheadOf((c1 - w) * sign, half, kappa, scale);
    ahead[1] = aheadOf((c2 - w) * sign, half, kappa, scale);
    ahead[2] = aheadOf((c3 - w) * sign, half, kappa, scale);
    ahead[3] = aheadOf((c4 - w) * sign, half, kappa, scale);
    ahead[4] = aheadOf((west - w) * sign, half, kappa, scale);
    ahead[5] = aheadOf((north - w) * sign, half, kappa, scale);
    return sign * (1 + this.decodeSize(beta, reach, kappa));
  }

  /** Return |q| - 1. */
  decodeSize(beta, reach, kappa) {
    const { ahead, decoder, models } = this;
    const first = 6179 + 14 * (8 * beta + reach);
    const mixer = 11 + (beta >> 2);
    let ones = 0;
    while (ones < 14) {
      let beyond = 0;
      let here = 0;
      for (let k = 0; k < 6; k++) {
        if (ahead[k] > ones) beyond++;
        else if (ahead[k] === ones) here++;
      }
      const h = 11107 + 18 * (14 * beta + ones) + 3 * Math.min(beyond, 5) + Math.min(here, 2);
      if (!this.mixedBit(first + ones, h, mixer)) break;
      ones++;
    }
    if (kappa === 0 && ones < 14) return ones;
    let upper = ones;
    if (ones === 14) {
      const nBits = decoder.unary(models, 22899, 31);
      upper = 13 + 2 ** nBits + decoder.raw(nBits);
    }
    let low = 0;
    let model = 22195 + 16 * beta + 4 * Math.min(ones, 3);
    for (let k = 0; k < Math.min(kappa, 2); k++) {
      const bit = decoder.bit(models, model);
      low = 2 * low + bit;
      if (k === 0) model += 1 + bit;
    }
    const rest = Math.max(kappa - 2, 0);
    return upper * power(kappa) + low * power(rest) + decoder.raw(rest);
  }
}

const kappaOf = (beta) => (beta ? Math.max(0, ((24 + 4 * (beta - 1)) >> 3) - 9) : 0);

/** Return t' of P.7, at most 15, of a distance in the detail's direction; -1 where it does not count. */
function aheadOf(distance, half, kappa, scale) {
  if (distance <= 0) return -1;
  const t = scale.steps(distance + half, 0);
  return t > 0 ? Math.min(Math.floor((t - 1) * power(-kappa)), 15) : -1;
}

function rho(d, e) {
  return Math.min((lg(d + e + 77) - lg(e + 77)) >> 2, 7);
}

function mu(d, e, scale) {
  const g = Math.max(e, 128);
  const s = scale.steps(Math.abs(d), 2);
  const size = Math.min((lg(2 * s + g) - lg(g)) >> 2, 4);
  return d > 0 && s > 0 ? 4 + size : 4 - size;
}
