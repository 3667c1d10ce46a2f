/** Method rapid (docs/format-rapid.md, whose sections are cited as R.n). */

import { bitLength } from "./bytes.js";
import { corrected } from "./corrections.js";
import { require } from "./errors.js";
import { kernels } from "./kernels.js";
import { compiledNarrow, compiledWide } from "./rapid-kernels.js";
import * as narrow from "./rapid-rows.js";
import { DOWN, HH, HL, LH, MARGIN, Workspace } from "./rapid-rows.js";
import { SharedRows } from "./rapid-shared.js";
import { Streams } from "./rapid-streams.js";
import { rangeShift } from "./rapid-tables.js";
import * as wide from "./rapid-wide.js";

const MOST = 2 ** 31 - 64;
const FINE_STEP = 3;
const MOST_SYMBOL = 31;
const REACH = 3; // rows and columns that are read outside a plane

// One thread, one unit at a time: nothing is kept in them between units.
const workspaces = new Map();

const MAKE = new Map([
  [narrow, () => new Workspace(Int32Array, 257, 257)],
  [wide, () => new Workspace(Float64Array, 257, 257)],
  [compiledNarrow, () => compiledNarrow.makeWorkspace()],
  [compiledWide, () => compiledWide.makeWorkspace()],
]);

function workspaceOf(arithmetic) {
  if (!workspaces.has(arithmetic)) workspaces.set(arithmetic, MAKE.get(arithmetic)());
  return workspaces.get(arithmetic);
}

/** What follows from the step and the range of heights. */
function scaleOf(step, low, high, isByReach) {
  const log2 = bitLength(step) - 1;
  const isFine = step <= FINE_STEP;
  const sideShift = Math.max(log2 - 5, 0);
  const mostDetail = Math.floor((high - low) / step) + 1;
  return {
    step, isFine, isByReach, sideShift,
    errorShift: log2,
    rangeShift: rangeShift(step),
    mostRange: 2 ** (15 + Math.min(log2, 4)) - 1,
    sideScale: Math.floor(65536 / (8 * step)),
    farScale: Math.floor((1024 * 2 ** log2) / step),
    endShift: 2 + log2 - sideShift,
    mostDetail,
    isSmall: Math.max(mostDetail, MOST_SYMBOL) * step < 2 ** 30, // with a height: fits 32 bits
  };
}

/** R.2: the lowest and highest height, and what all are less in the workspace. */
function limitsOf({ zMin, zMax }, widest, isWide, parent) {
  if (isWide) return { low: zMin, high: zMax, origin: 0 };
  let origin = 0;
  if (parent !== null && Math.max(-zMin, zMax) * widest > MOST) {
    let least = Infinity;
    let most = -Infinity;
    for (let r = 0; r < parent.rows.n; r++) {
      const start = parent.base + r * parent.stride;
      for (let i = start; i < start + parent.cols.n; i++) {
        least = Math.min(least, parent.heights[i]);
        most = Math.max(most, parent.heights[i]);
      }
    }
    origin = Math.floor((least + most) / 2);
  }
  const reach = Math.floor(MOST / widest);
  return { low: Math.max(zMin, origin - reach), high: Math.min(zMax, origin + reach), origin };
}

/** Whole-sample symmetry about 0 and n - 1, repeated until inside (R.5). */
function fold(i, n) {
  if (n === 1) return 0;
  const period = 2 * (n - 1);
  const inside = ((i % period) + period) % period;
  return Math.min(inside, period - inside);
}

/** Copy n samples of a row to every `step`-th place, adding `origin`. */
function spread(from, at, n, to, start, step, origin) {
  for (let j = 0, k = start; j < n; j++, k += step) to[k] = from[at + j] + origin;
}

/** Copy n samples of every `step`-th place to a row. */
function gather(from, start, step, to, at, n) {
  for (let j = 0, k = start; j < n; j++, k += step) to[at + j] = from[k];
}

/** Decodes the rows of one unit. */
class Coder {
  constructor(file, unit, payload, valid, parent, hasVoid, corrections) {
    const { header, tables } = file;
    const { rows, cols } = unit;
    Object.assign(this, { header, tables, unit, valid, parent, corrections });
    this.streams = new Streams(payload, tables);
    const { low, high, origin } = limitsOf(header, tables.widest, this.streams.isWide, parent);
    require(low <= high, "heights of a unit that is not wide");
    Object.assign(this, { low: low - origin, high: high - origin, origin });
    this.scale = scaleOf(header.step, low, high, tables.isByReach);
    this.isCompiled = kernels.rapid !== null;
    const choice = this.isCompiled ? [compiledNarrow, compiledWide] : [narrow, wide];
    this.arithmetic = choice[this.streams.isWide ? 1 : 0];
    const m = this.workspace = workspaceOf(this.arithmetic);
    m.take((rows.nCore + 1) >> 1, (cols.nCore + 1) >> 1, valid, this.streams);
    if (this.isCompiled) this.streams.moveTo(m);
    // Rows are finished with their errors in one pass, where numbers of the pass hold them and
    // nothing is corrected in between.
    this.finishes = corrections !== null ? false : this.isCompiled ? this.streams.isWide || this.scale.isSmall
      : !this.streams.isWide && this.scale.isSmall;
    this.hasVoid = hasVoid;
    this.heights = m.heights.subarray(0, valid.length);
    if (this.isCompiled) this.heights.fill(0);
    this.takeClass(1);
  }

  takeClass(stride) {
    const { tables, unit } = this;
    const depth = tables.kMax - unit.level + bitLength(stride) - 1;
    const which = Math.min(Math.max(depth, 0), 3);
    this.stencils = tables.stencils[which];
    this.features = tables.features[which];
  }

  /** Return a height as others read it: clamped, less the origin. */
  inside(height) {
    return Math.min(Math.max(height - this.origin, this.low), this.high);
  }

  decodeGroup(rings) {
    const { unit, parent, heights, valid } = this;
    const { rows, cols } = unit;
    new SharedRows(this, unit, parent, heights, valid, rings).decode();
    // What is known of the core: the lines of shared sides.
    const known = (axis) => axis.isShared.map((isShared) => (isShared ? rings + 1 : 0));
    const start = parent.base + (rows.coreFirst / 2 - parent.rows.first) * parent.stride +
      cols.coreFirst / 2 - parent.cols.first;
    const coarse = { heights: parent.heights, start, rowStep: parent.stride, colStep: 1 };
    this.decodeLattice(1, coarse, known(rows), known(cols));
  }

  /** R.4. */
  decodeRoot() {
    const { unit: { rows, cols }, heights, low, high, header, streams } = this;
    let stride = 1;
    while (stride < Math.max(rows.nCore, cols.nCore) - 1) stride *= 2;
    const nBits = bitLength(Math.floor((high - low) / header.step));
    const half = (header.step - 1) / 2;
    for (let i = 0; i < rows.nCore; i += stride) {
      for (let j = 0; j < cols.nCore; j += stride) {
        const place = (rows.core + i) * cols.n + cols.core + j;
        let height = Math.floor((low + high) / 2);
        if (this.valid[place]) {
          const lowest = streams.bits(Math.min(nBits, 16));
          const index = lowest + streams.bits(Math.max(nBits - 16, 0)) * 65536;
          height = Math.min(low + index * header.step + half, high);
        }
        heights[place] = corrected(this.corrections, place, height, low, high);
      }
    }
    while (stride > 1) {
      const coarse = {
        heights, start: rows.core * cols.n + cols.core, rowStep: stride * cols.n, colStep: stride,
      };
      stride /= 2;
      this.takeClass(stride);
      this.decodeLattice(stride, coarse, [0, 0], [0, 0]);
    }
  }

  /** R.5: `coarse` says where plane A lies; the rest goes to the heights of the region. */
  decodeLattice(stride, coarse, knownRows, knownCols) {
    const { workspace: m, unit: { rows, cols } } = this;
    const nRows = Math.floor((rows.nCore - 1) / stride) + 1;
    const nCols = Math.floor((cols.nCore - 1) / stride) + 1;
    const [nEven, nEvenCols] = [(nRows + 1) >> 1, (nCols + 1) >> 1];
    m.reserve(nEven, nEvenCols);
    this.loadCoarse(coarse, nRows, nCols);
    this.fillBends(nEven, nEvenCols);
    this.storeCoarse(stride, nEven, nEvenCols);
    const sizes = [
      [nRows >> 1, nCols >> 1], [nEven, nCols >> 1], [nRows >> 1, nEvenCols],
    ];
    this.beginPlanes(nRows, nCols, sizes, nEven);
    for (let t = 0; t < nEven + 2; t++) {
      for (let plane = HH; plane <= LH; plane++) {
        const i = t - plane;
        const [nOwn, n] = sizes[plane];
        if (i < 0 || i >= nOwn || n === 0) continue;
        this.decodeRow(plane, i, n, stride, [nRows, nCols], knownRows, knownCols);
        this.surround(plane, i, nOwn, n);
      }
    }
  }

  at(row) {
    return (row + MARGIN) * this.workspace.stride + MARGIN;
  }

  /** Fill plane A and what lies around it, mirrored where the lattice ends. */
  loadCoarse({ heights, start, rowStep, colStep }, nRows, nCols) {
    const { workspace: m, low, high, origin } = this;
    const [nEven, n] = [(nRows + 1) >> 1, (nCols + 1) >> 1];
    const to = m.coarse;
    for (let row = -MARGIN; row < nEven + MARGIN; row++) {
      const from = start + (fold(2 * row, nRows) >> 1) * rowStep;
      const at = this.at(row);
      for (let j = 0, k = from; j < n; j++, k += colStep) {
        const height = heights[k] - origin;
        to[at + j] = height < low ? low : height > high ? high : height;
      }
      for (let k = 1; k <= REACH; k++) {
        to[at - k] = to[at + (fold(-2 * k, nCols) >> 1)];
        to[at + n - 1 + k] = to[at + (fold(2 * (n - 1 + k), nCols) >> 1)];
      }
    }
  }

  /** Fill curvatures of plane A, and one sample beyond it (R.7). */
  fillBends(nEven, n) {
    const { workspace: m, scale: { rangeShift: shift, mostRange } } = this;
    const { coarse: a, bends, stride } = m;
    const unit = 1 / 2 ** shift;
    const arithmetic = this.arithmetic;
    for (let row = 0; row < nEven; row++) {
      const at = this.at(row);
      if (this.isCompiled) {
        arithmetic.fillBends(m, at, n, shift, mostRange);
      } else {
        for (let i = at; i < at + n; i++) {
          const across = a[i - 2] + a[i + 2] - 4 * (a[i - 1] + a[i + 1]) + 6 * a[i];
          const along = a[i - 2 * stride] + a[i + 2 * stride] -
            4 * (a[i - stride] + a[i + stride]) + 6 * a[i];
          bends[i] = Math.min((Math.abs(across) + Math.abs(along)) * unit, mostRange);
        }
      }
      bends[at + n] = bends[at + n - 1];
    }
    const last = this.at(nEven - 1);
    bends.copyWithin(last + stride, last, last + n + 1);
  }

  /** Errors above the first rows are 0, and heights there are means; so are empty planes. */
  beginPlanes(nRows, nCols, sizes, nEven) {
    const { workspace: m } = this;
    for (let plane = HH; plane <= LH; plane++) {
      const isEmpty = sizes[plane].includes(0);
      const n = isEmpty ? (plane === HH ? Math.max(nCols >> 1, 1) : 1) : sizes[plane][1];
      m.errors[plane].fill(0, 0, this.at(0) - MARGIN);
      if (isEmpty) m.errors[plane].fill(0);
      const [first, last] = isEmpty ? [-REACH, nEven + 2] : [-1, -1];
      for (let row = first; row <= last; row++) {
        this.fillMeans(plane, row, isEmpty ? row : 0, n);
        this.extend(m.planes[plane], this.at(row), n);
      }
    }
  }

  fillMeans(plane, row, from, n) {
    const { workspace: { coarse: a, planes, stride } } = this;
    const to = this.at(row);
    const east = plane === LH ? 0 : 1;
    const south = plane === HL ? 0 : stride;
    for (let j = 0, i = this.at(from); j < n; j++, i++) {
      // Of HL and LH the same two samples twice: (2(a + b) + 2) >> 2.
      const sum = a[i] + a[i + east] + a[i + south] + a[i + south + east];
      planes[plane][to + j] = Math.floor((sum + 2) / 4);
    }
  }

  /** Copy a row's first and last sample beside it. */
  extend(plane, at, n) {
    for (let k = 0; k < REACH; k++) {
      plane[at - 1 - k] = plane[at];
      plane[at + n + k] = plane[at + n - 1];
    }
  }

  /** Make a row readable beside it, and above and below the plane. */
  surround(plane, row, nRows, n) {
    const { workspace: m } = this;
    const at = this.at(row);
    for (const array of [m.planes[plane], m.errors[plane]]) {
      this.extend(array, at, n);
      const copy = (to) => array.copyWithin(this.at(to) - REACH, at - REACH, at + n + REACH);
      if (row === 0) [-1, -2, -3].forEach(copy);
      if (row === nRows - 1) [row + 1, row + 2].forEach(copy);
    }
  }

  decodeRow(plane, i, n, stride, [nRows, nCols], knownRows, knownCols) {
    const { workspace: m, arithmetic, scale, unit: { rows, cols }, heights, origin } = this;
    const at = this.at(i);
    const features = this.features[plane];
    arithmetic.predictRow[plane](m, at, n, this.stencils[plane], features);
    arithmetic.fillContexts(m, n, features, scale);
    const latticeRow = 2 * i + (plane === HL ? 0 : 1);
    const col = plane === LH ? 0 : 1;
    const start = (rows.core + latticeRow * stride) * cols.n + cols.core + col * stride;
    const step = 2 * stride;
    let first = Math.min((knownCols[0] + 1 - col) >> 1, n);
    let stop = Math.max(n - ((knownCols[1] + 1 - ((nCols - 1 - col) & 1)) >> 1), first);
    if (latticeRow < knownRows[0] || latticeRow >= nRows - knownRows[1]) first = stop = n;
    const own = m.planes[plane];
    for (let j = 0; j < first; j++) own[at + j] = this.inside(heights[start + j * step]);
    for (let j = stop; j < n; j++) own[at + j] = this.inside(heights[start + j * step]);
    if (first < stop) {
      this.readDetails(first, stop, start, step);
      if (this.finishes) {
        arithmetic.finishRow(m, plane, at, first, stop, this, scale, start, step);
        if (first > 0) arithmetic.noteErrors(m, plane, at, 0, first, scale);
        if (stop < n) arithmetic.noteErrors(m, plane, at, stop, n, scale);
        return;
      }
      this.fillHeights(own, at, first, stop);
      this.correct(own, at, first, stop, (j) => start + j * step);
      spread(own, at + first, stop - first, heights, start + first * step, step, origin);
    }
    arithmetic.noteErrors(m, plane, at, 0, n, scale);
  }

  /** Read the details of a row; of each, the sample is at every `step`-th place of the region. */
  readDetails(first, stop, start, step) {
    const { workspace: m, arithmetic, scale: { mostDetail } } = this;
    if (this.isCompiled) {
      const valid = this.hasVoid ? m.regionValid.byteOffset + start : 0;
      arithmetic.readDetails(m, first, stop, valid, step, mostDetail);
      return;
    }
    if (this.hasVoid) gather(this.valid, start + first * step, step, m.valid, first, stop - first);
    this.streams.readDetails(m, first, stop, this.hasVoid ? m.valid : null, mostDetail);
  }

  /** Read details of samples that are valid where the workspace says so. */
  readLine(n) {
    const { workspace: m, arithmetic, scale: { mostDetail } } = this;
    if (this.isCompiled) arithmetic.readDetails(m, 0, n, m.valid.byteOffset, 1, mostDetail);
    else this.streams.readDetails(m, 0, n, m.valid, mostDetail);
  }

  /** Write the heights of samples first … stop - 1 of a row to `to`, its own from `at` on. */
  fillHeights(to, at, first, stop) {
    const { workspace: { whole, details, contexts }, scale: { step, isSmall }, low, high } = this;
    if (isSmall) {
      for (let j = first; j < stop; j++) {
        const change = Math.imul(details[j], step);
        const height = (contexts[j] & DOWN ? whole[j] - change : whole[j] + change) | 0;
        to[at + j] = Math.min(Math.max(height, low), high);
      }
      return;
    }
    for (let j = first; j < stop; j++) {
      const change = details[j] * step;
      const height = contexts[j] & DOWN ? whole[j] - change : whole[j] + change;
      to[at + j] = height < low ? low : height > high ? high : height;
    }
  }

  /** Correct samples first … stop - 1 of a row that begins at `at`; `place` is theirs in the region. */
  correct(row, at, first, stop, place) {
    if (this.corrections === null) return;
    for (let j = first; j < stop; j++) {
      row[at + j] = corrected(this.corrections, place(j), row[at + j], this.low, this.high);
    }
  }

  /** Write plane A to the region, as it is read: inherited samples are clamped (R.2). */
  storeCoarse(stride, nEven, n) {
    const { workspace: m, unit: { rows, cols }, heights, origin } = this;
    for (let row = 0; row < nEven; row++) {
      const to = (rows.core + 2 * row * stride) * cols.n + cols.core;
      if (this.isCompiled) {
        this.arithmetic.storeRow(m, n, this.at(row), to, 2 * stride, origin);
        continue;
      }
      for (let j = 0, at = this.at(row); j < n; j++, at++) {
        heights[to + 2 * j * stride] = m.coarse[at] + origin;
      }
    }
  }
}

/** Return the heights of the region of a unit. */
export function decodeRapid(file, unit, payload, valid, parent, hasVoid, corrections) {
  const coder = new Coder(file, unit, payload, valid, parent, hasVoid, corrections);
  if (parent === null) coder.decodeRoot();
  else coder.decodeGroup(file.grid.rings);
  coder.streams.end();
  return coder.isCompiled ? coder.heights.slice() : coder.heights;
}
