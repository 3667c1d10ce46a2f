/** Method predictive (docs/format-predictive.md, whose sections are cited as P.n). */

import { require } from "./errors.js";
import { Mixers, Scale, lg, meanBit } from "./predictive-bits.js";
import { Border } from "./predictive-border.js";
import { borderModels, detailModels } from "./predictive-tables.js";
import { RangeDecoder } from "./rangecoder.js";

const REACH = 5; // lattice places farther outside are never read
const [HH, HL, LH] = [0, 1, 2];
const PARITY = [[1, 1], [0, 1], [1, 0]];
const SMALL = 1024; // lattices of fewer samples have no headers of planes
const MOST_BEND = 2 ** 31 - 1;

const OWN = [[0, -2], [-2, 0], [-2, -2], [-2, 2]];
// prettier-ignore
const AFTER_OWN = [
  [0, -1], [0, 1], [0, -3], [0, 3], [-1, 0], [1, 0], [-1, -2], [-1, 2], [1, -2], [1, 2],
  [-2, -1], [-2, 1], [2, -1], [2, 1], [-3, 0], [3, 0],
];
const ODD = [-3, -1, 1, 3];
const DIAGONAL = [[-1, -1], [-1, 1], [1, -1], [1, 1]];
const turned = (places) => places.map(([r, c]) => [c, r]);
const row = [[0, -3], [0, -1], [0, 1], [0, 3]];

/** Places [row, column] in lattice steps from the sample that is predicted, by plane (P.5, P.6). */
const PLACES = [
  {
    taps: [...OWN, ...ODD.flatMap((r) => ODD.map((c) => [r, c]))],
    core: DIAGONAL, near: [], far: [], active: [], bent: DIAGONAL,
    lines: [-1, 1].flatMap((k) => [ODD.map((c) => [k, c]), ODD.map((r) => [r, k])]),
  },
  {
    taps: [...OWN, ...AFTER_OWN],
    core: [[0, -1], [0, 1], [-1, 0], [1, 0]], near: [[-1, 0], [1, 0]],
    far: [[-1, -2], [-1, 2], [1, -2], [1, 2]], active: [[1, 0]], bent: [[0, -1], [0, 1]],
    lines: [row, turned(row)],
  },
  {
    taps: [...OWN, ...turned(AFTER_OWN), ...DIAGONAL],
    core: [[-1, 0], [1, 0], [0, -1], [0, 1]], near: [[0, -1], [0, 1], ...DIAGONAL],
    far: [[-2, -1], [-2, 1], [2, -1], [2, 1]], active: [[0, 1], [1, 1]],
    bent: [[-1, 0], [1, 0]], lines: [row, turned(row)],
  },
];

/** Whole-sample symmetry about 0 and n - 1, repeated until inside. */
function fold(i, n) {
  const period = 2 * (n - 1);
  if (period === 0) return 0;
  const inside = ((i % period) + period) % period;
  return Math.min(inside, period - inside);
}

/** Samples of a lattice, and what is known of planes coded before, with margins of REACH. */
class Lattice {
  constructor(unit, stride, heights) {
    Object.assign(this, { unit, stride, heights });
    this.nRows = Math.floor((unit.rows.nCore - 1) / stride) + 1;
    this.nCols = Math.floor((unit.cols.nCore - 1) / stride) + 1;
    this.pitch = this.nCols + 2 * REACH;
    const n = (this.nRows + 2 * REACH) * this.pitch;
    this.values = new Int32Array(n);
    this.errors = new Int32Array(n);
    this.activity = new Int32Array(n);
    this.bends = new Int32Array(n);
    this.rowsOf = Int32Array.from({ length: this.nRows + 2 * REACH }, (_, r) => fold(r - REACH, this.nRows));
    this.colsOf = Int32Array.from({ length: this.nCols + 2 * REACH }, (_, c) => fold(c - REACH, this.nCols));
    this.load();
    this.fillBends();
  }

  at(r, c) {
    return (r + REACH) * this.pitch + c + REACH;
  }

  /** Return the place in the region of a lattice place inside. */
  place(r, c) {
    const { rows, cols } = this.unit;
    return (rows.core + r * this.stride) * cols.n + cols.core + c * this.stride;
  }

  /** Call `use` for each place of one parity, with margins, and the place inside it stands for. */
  each([down, right], use) {
    const { rowsOf, colsOf, pitch } = this;
    for (let r = down ^ (REACH & 1); r < rowsOf.length; r += 2) {
      for (let c = right ^ (REACH & 1); c < colsOf.length; c += 2) {
        use(r * pitch + c, rowsOf[r], colsOf[c]);
      }
    }
  }

  isEmpty([down, right]) {
    return (down && this.nRows === 1) || (right && this.nCols === 1);
  }

  load() {
    const { heights, values } = this;
    const coarse = (r, c) => heights[this.place(fold(r, this.nRows), fold(c, this.nCols))];
    this.each([0, 0], (i, r, c) => { values[i] = heights[this.place(r, c)]; });
    for (const parity of PARITY) {
      if (!this.isEmpty(parity)) continue;
      const [down, right] = parity;
      for (let i = down ^ (REACH & 1); i < this.rowsOf.length; i += 2) {
        for (let j = right ^ (REACH & 1); j < this.colsOf.length; j += 2) {
          const [r, c] = [i - REACH, j - REACH];
          const sum = coarse(r - down, c - right) + coarse(r - down, c + right) +
            coarse(r + down, c - right) + coarse(r + down, c + right);
          // Of HL and LH the same two samples twice: (2(a + b) + 2) >> 2.
          values[i * this.pitch + j] = Math.floor((sum + 2) / 4);
        }
      }
    }
  }

  /** Curvatures of plane A (P.6). */
  fillBends() {
    const { values: a, bends, pitch } = this;
    const along = (i, step) =>
      Math.abs(a[i - 2 * step] - 4 * a[i - step] + 6 * a[i] - 4 * a[i + step] + a[i + 2 * step]);
    for (let r = 0; r < this.nRows; r += 2) {
      for (let c = 0; c < this.nCols; c += 2) {
        const i = this.at(r, c);
        bends[i] = Math.min(along(i, 2) + along(i, 2 * pitch), MOST_BEND);
      }
    }
    this.each([0, 0], (i, r, c) => { bends[i] = bends[this.at(r, c)]; });
  }

  /** Make a plane that has been coded readable outside. */
  surround(parity) {
    const { values, errors, activity } = this;
    this.each(parity, (i, r, c) => {
      const from = this.at(r, c);
      values[i] = values[from];
      errors[i] = errors[from];
      activity[i] = activity[from];
    });
  }
}

/** One plane of a lattice (P.5 … P.7). */
class PlaneDecoder {
  constructor(lattice, plane, stencil, weights, unit) {
    Object.assign(this, { lattice, plane, stencil, weights, ...unit });
    const { pitch } = lattice;
    const offsets = (places) => Int32Array.from(places, ([r, c]) => r * pitch + c);
    const { taps, core, near, far, active, bent, lines } = PLACES[plane];
    this.taps = offsets(taps);
    this.core = offsets(core);
    this.near = offsets(near);
    this.far = offsets(far);
    this.active = offsets(active);
    this.bent = offsets(bent);
    this.lines = lines.map(offsets);
    [this.down, this.right] = PARITY[plane];
    this.nRows = (lattice.nRows + 1 - this.down) >> 1;
    this.nCols = (lattice.nCols + 1 - this.right) >> 1;
    // Errors of this plane with two samples before each row and one after; two rows above.
    this.pitch = this.nCols + 3;
    this.errors = new Int32Array((this.nRows + 2) * this.pitch);
    this.six = new Float64Array(6); // the sorted core, then the heights at W and N
    this.ahead = new Float64Array(6);
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
      for (let j = 0; j < this.nCols; j++) this.decodeSample(i, j);
      errors[start + this.nCols] = errors[start + this.nCols - 1];
      this.finishRow(i);
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

  decodeSample(i, j) {
    const { lattice, taps, core, stencil, six, step, scale, zMin, zMax } = this;
    const { values } = lattice;
    const at = this.at(i, j);
    let sum = 32;
    for (let k = 0; k < taps.length; k++) sum += stencil[k] * values[at + taps[k]];
    let p = Math.floor(sum / 64);
    for (let k = 0; k < 4; k++) six[k] = values[at + core[k]];
    sortFour(six);
    const off = Math.abs(p - 16 * (six[0] + six[1] + six[2] + six[3]));
    if (this.isClamped) p = Math.min(Math.max(p, 64 * six[0]), 64 * six[3]);
    p = Math.min(Math.max(p, 64 * zMin), 64 * zMax);
    const w = Math.floor((p + 32) / 64);
    const place = lattice.place(2 * i + this.down, 2 * j + this.right);
    const isKnown = this.known[place];
    const isValid = this.valid[place];
    let height = w;
    if (isKnown) {
      height = lattice.heights[place];
    } else if (isValid) {
      const e = this.expected(i, j, at, p, off);
      six[4] = values[at - 2];
      six[5] = values[at - 2 * lattice.pitch];
      height = Math.min(Math.max(w + this.decodeDetail(e, p, w) * step, zMin), zMax);
    }
    lattice.heights[place] = height;
    values[at] = height;
    let error = 0;
    if (isValid || isKnown) error = Math.min(scale.steps(Math.abs(64 * height - p), -1), 32767);
    this.errors[(i + 2) * this.pitch + 2 + j] = error;
    lattice.errors[at] = error;
  }

  /** Fill the activity of a row (P.6). */
  finishRow(i) {
    const { errors, pitch, lattice: { activity } } = this;
    const last = this.nCols - 1;
    for (let j = 0; j <= last; j++) {
      const e = (i + 2) * pitch + 2 + j;
      let u = 0;
      if (i > 0) {
        const above = this.at(i - 1, j);
        const left = j > 0 ? activity[above - 2] : activity[above];
        const right = j < last ? activity[above + 2] : activity[above];
        u = left + 2 * activity[above] + right;
      }
      activity[this.at(i, j)] = errors[e - 1] + 2 * errors[e] + errors[e + 1] + ((3 * u) >> 4);
    }
  }

  /** Return E (P.6). */
  expected(i, j, at, p, off) {
    const { weights: w, errors, pitch, lattice, six, core, scale } = this;
    const { values, activity, bends } = lattice;
    const own = (i + 2) * pitch + 2 + j;
    let total = w[0] * errors[own - 1] + w[1] * errors[own - 2] + w[2] * errors[own - pitch] +
      w[3] * errors[own - pitch - 1] + w[4] * errors[own - pitch + 1] + w[5] * errors[own - 2 * pitch];
    total += w[6] * sumAt(lattice.errors, at, this.near) + w[7] * sumAt(lattice.errors, at, this.far);
    const above = i > 0 ? activity[at - 2 * lattice.pitch] : 0;
    total += w[15] + w[16] * above + w[17] * sumAt(activity, at, this.active);
    const [a, b] = [values[at + core[0]], values[at + core[1]]];
    const [c, d] = [values[at + core[2]], values[at + core[3]]];
    const twist = Math.abs(this.plane === HH ? a + d - b - c : a + b - c - d);
    let lines = 0;
    for (const line of this.lines) {
      lines += Math.abs(values[at + line[0]] - values[at + line[1]] - values[at + line[2]] +
        values[at + line[3]]);
    }
    const bent = sumAt(bends, at, this.bent);
    const distance = 64 * (w[8] * bent + w[9] * (six[3] - six[0]) + w[12] * twist + w[13] * lines) +
      w[10] * Math.abs((six[1] + six[2]) * 32 - p) + w[11] * Math.abs((six[0] + six[3]) * 32 - p) +
      w[14] * off;
    total += scale.steps(distance, -1);
    return Math.min(Math.floor(total / 64), 2 ** 28 - 1);
  }

  bit(b, h) {
    return this.isMixed ? meanBit(this.decoder, this.models, b, h) : this.decoder.bit(this.models, b);
  }

  mixedBit(b, h, mixer) {
    return this.isMixed
      ? this.mixers.bit(this.decoder, this.models, b, h, mixer)
      : this.decoder.bit(this.models, b);
  }

  /** Return the detail q (P.7). */
  decodeDetail(e, p, w) {
    const { six, scale, step } = this;
    const half = (step - 1) / 2;
    const phi = p - 64 * w;
    const beta = Math.min(Math.max(((lg(e) - 24) >> 2) + 1, 0), 43);
    let up = 0;
    let down = 0;
    for (let k = 0; k < 6; k++) {
      if (six[k] > w + half) up++;
      else if (six[k] < w - half) down++;
    }
    const same = 6 - up - down;
    const range = rho(scale.steps(six[3] - six[0], 8), e);
    const side = Math.min(scale.steps(Math.abs(phi), -3), 3);
    const most = Math.min(up, down, 3);
    if (!this.bit(4 * (8 * beta + range) + side, 1408 + 4 * (7 * beta + same) + most)) return 0;
    let epsilon = 0;
    for (const x of [50, 61, 72, 84]) if (x < 24 + 4 * beta) epsilon++;
    const slope = Math.min((scale.steps(6 * Math.abs(phi), -5) + 1) >> 1, 3);
    const sigma = phi > 0 ? 3 + slope : 3 - slope;
    const inner = mu((six[1] + six[2]) * 32 - p, e, scale);
    const outer = mu((six[0] + six[3]) * 32 - p, e, scale);
    const b = 2640 + 9 * (9 * (7 * epsilon + sigma) + inner) + outer;
    const isUp = this.mixedBit(b, 5475 + 8 * (8 * (beta >> 2) + up) + down, beta >> 2);
    const size = 1 + this.decodeSize(beta, e, isUp, p, w, half);
    return isUp ? size : -size;
  }

  /** Return |q| - 1. */
  decodeSize(beta, e, isUp, p, w, half) {
    const { six, ahead, scale, decoder, models } = this;
    const kappa = beta ? Math.max(0, ((24 + 4 * (beta - 1)) >> 3) - 9) : 0;
    const room = isUp ? 64 * six[3] - p : p - 64 * six[0];
    const reach = rho(scale.steps(Math.max(room, 0), 2), e);
    let nAhead = 0;
    for (let k = 0; k < 6; k++) {
      const t = scale.steps(Math.abs(six[k] - w) + half, 0);
      if (six[k] > w === (isUp === 1) && t > 0) ahead[nAhead++] = Math.floor((t - 1) / 2 ** kappa);
    }
    let ones = 0;
    while (ones < 14) {
      let beyond = 0;
      let here = 0;
      for (let k = 0; k < nAhead; k++) {
        if (ahead[k] > ones) beyond++;
        else if (ahead[k] === ones) here++;
      }
      const h = 11107 + 18 * (14 * beta + ones) + 3 * Math.min(beyond, 5) + Math.min(here, 2);
      if (!this.mixedBit(6179 + 14 * (8 * beta + reach) + ones, h, 11 + (beta >> 2))) break;
      ones++;
    }
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
    return upper * 2 ** kappa + low * 2 ** rest + decoder.raw(rest);
  }
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

function sumAt(array, at, offsets) {
  let sum = 0;
  for (let k = 0; k < offsets.length; k++) sum += array[at + offsets[k]];
  return sum;
}

/** Sort the first four in place. */
function sortFour(x) {
  const order = (a, b) => {
    if (x[a] <= x[b]) return;
    const larger = x[a];
    x[a] = x[b];
    x[b] = larger;
  };
  order(0, 1);
  order(2, 3);
  order(0, 2);
  order(1, 3);
  order(1, 2);
}

/** Return the heights of the region of a unit (P.1). */
export function decodePredictive(file, unit, payload, valid, parent) {
  require(payload.length >= 1, "a payload of predictive is empty");
  const flags = payload[0];
  require(flags < 4, "flags of predictive");
  const { header, grid, tables } = file;
  const decoder = new RangeDecoder(payload.subarray(1));
  const heights = new Int32Array(valid.length);
  const border =
    new Border(decoder, borderModels(), unit, parent, heights, valid, header, grid.rings);
  let stride = 2;
  if (parent === null) {
    stride = border.decodeRootCorners();
  } else {
    border.decodeShared();
    border.takeParents();
  }
  const shared = {
    decoder, valid, known: border.known,
    models: detailModels(), mixers: new Mixers(22), scale: new Scale(header.step),
    isMixed: (flags & 1) !== 0, isClamped: (flags & 2) !== 0,
    step: header.step, zMin: header.zMin, zMax: header.zMax,
  };
  while (stride > 1) {
    stride /= 2;
    const lattice = new Lattice(unit, stride, heights);
    for (let plane = HH; plane <= LH; plane++) {
      if (!lattice.isEmpty(PARITY[plane])) decodePlane(tables, lattice, plane, shared);
    }
  }
  decoder.end();
  return heights;
}

/** Read the header of a plane and decode it (P.5). */
function decodePlane(tables, lattice, plane, shared) {
  let set = 0;
  let class_ = 2;
  if (lattice.nRows * lattice.nCols >= SMALL) {
    const number = shared.decoder.raw(6);
    set = number >> 2;
    class_ = number & 3;
  }
  require(set < tables.stencils[plane].length, "set of a plane");
  require(class_ < tables.weights[plane].length, "class of a plane");
  const { stencils, weights } = tables;
  new PlaneDecoder(lattice, plane, stencils[plane][set], weights[plane][class_], shared).run();
}
