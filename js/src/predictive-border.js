/** What a unit of method predictive codes before its lattices (P.3, P.4). */

import { corrected } from "./corrections.js";
import { binOf } from "./predictive-bits.js";
import { parentLines, sharedLines } from "./rapid-shared.js";

const MOST = 2 ** 30;

export class Border {
  constructor(decoder, models, unit, parent, heights, valid, { step }, rings,
    corrections) {
    Object.assign(this, { decoder, models, unit, parent, heights, valid, step, rings, corrections });
    this.known = new Uint8Array(heights.length);
    this.mostDetail = Math.floor((4 * MOST) / step) + 1;
  }

  symbol(pass, s) {
    const { decoder, models } = this;
    const model = 36 * pass + binOf(s);
    if (!decoder.bit(models, model)) return 0;
    const size = 1 + decoder.magnitude(models, 180 + 14 * model, 2700 + 32 * pass, 0);
    return decoder.raw(1) ? -size : size;
  }

  put(place, prediction, detail) {
    const q = Math.min(Math.max(detail, -this.mostDetail), this.mostDetail);
    const height = Math.min(Math.max(prediction + q * this.step, -MOST), MOST);
    this.heights[place] = corrected(this.corrections, place, height, -MOST, MOST);
    this.known[place] = 1;
  }

  above(row, col) {
    return this.parent.heights[this.parent.base + row * this.parent.stride + col];
  }

  /** P.3. */
  decodeShared() {
    const { rows, cols } = this.unit;
    const rowSides = sharedLines(rows, this.rings);
    const colSides = sharedLines(cols, this.rings);
    for (const side of rowSides) {
      for (const other of colSides) {
        for (const row of side) for (const col of other) this.decodeCorner(row, col);
      }
    }
    for (const row of new Set(rowSides.flat())) {
      const [before, after] = parentLines(rows, this.parent.rows, row);
      const [first] = parentLines(cols, this.parent.cols, cols.core);
      this.decodeLine(row * cols.n + cols.core, 1, cols.nCore, (rows.first + row) & 1,
        (k) => this.above(before, first + k) + this.above(after, first + k));
    }
    for (const col of new Set(colSides.flat())) {
      const [before, after] = parentLines(cols, this.parent.cols, col);
      const [first] = parentLines(rows, this.parent.rows, rows.core);
      this.decodeLine(rows.core * cols.n + col, cols.n, rows.nCore, (cols.first + col) & 1,
        (k) => this.above(first + k, before) + this.above(first + k, after));
    }
  }

  decodeCorner(row, col) {
    const { rows, cols } = this.unit;
    const place = row * cols.n + col;
    if (this.known[place]) return;
    const [top, bottom] = parentLines(rows, this.parent.rows, row);
    const [left, right] = parentLines(cols, this.parent.cols, col);
    const sum = this.above(top, left) + this.above(top, right) +
      this.above(bottom, left) + this.above(bottom, right);
    const isOdd = ((rows.first + row) | (cols.first + col)) & 1;
    const q = this.valid[place] && isOdd ? this.symbol(0, 16) : 0;
    this.put(place, Math.floor((sum + 2) / 4), q);
  }

  decodeLine(start, step, length, isOddLine, pair) {
    const { heights, known, valid } = this;
    const pairs = Array.from({ length: (length + 1) >> 1 }, (_, k) => pair(k));
    const predicted = Float64Array.from({ length }, (_, i) => predictOnLine(pairs, i));
    // What corner samples at the ends are was known before.
    const isCoded = Uint8Array.from({ length }, (_, i) => known[start + i * step] ^ 1);
    const error = (i) => heights[start + i * step] - predicted[i];
    for (let parity = 0; parity < 2; parity++) {
      let last = 0;
      let before = 0;
      for (let i = parity; i < length; i += 2) {
        if (!isCoded[i]) continue;
        let correction = 0;
        let near = last + before;
        if (parity) {
          const left = error(i - 1);
          const right = i + 1 < length ? error(i + 1) : left;
          correction = Math.floor((left + right) / 2);
          const far = 2 * Math.abs(left - correction) + 2 * Math.abs(right - correction);
          near = Math.floor(far / this.step) + last;
        }
        const bend = i > 0 && i < length - 1
          ? Math.abs(predicted[i - 1] - 2 * predicted[i] + predicted[i + 1]) : 0;
        const place = start + i * step;
        let q = 0;
        if (valid[place] && (isOddLine || parity)) {
          q = this.symbol(parity, 4 * near + Math.min(Math.floor((8 * bend) / this.step), 1024));
        }
        this.put(place, predicted[i] + correction, q);
        before = last;
        last = Math.min(Math.abs(q), 255);
      }
    }
  }

  /** P.4; returns the stride of the corners. */
  decodeRootCorners() {
    const { rows, cols } = this.unit;
    let stride = 1;
    while (stride < Math.max(rows.nCore, cols.nCore) - 1) stride *= 2;
    for (let i = 0; i < rows.nCore; i += stride) {
      for (let j = 0; j < cols.nCore; j += stride) {
        const place = (rows.core + i) * cols.n + cols.core + j;
        this.put(place, (this.step - 1) / 2, this.valid[place] ? this.symbol(2, 16) : 0);
      }
    }
    return stride;
  }

  /** P.2: samples of even row and column are the parent's. */
  takeParents() {
    const { rows, cols } = this.unit;
    const [top] = parentLines(rows, this.parent.rows, rows.core);
    const [left] = parentLines(cols, this.parent.cols, cols.core);
    for (let i = 0; i < rows.nCore; i += 2) {
      const to = (rows.core + i) * cols.n + cols.core;
      for (let j = 0; j < cols.nCore; j += 2) {
        this.heights[to + j] = this.above(top + i / 2, left + j / 2);
      }
    }
  }
}

function predictOnLine(v, i) {
  const m = v.length;
  const k = i >> 1;
  if (i % 2 === 0) return Math.floor((v[k] + 1) / 2);
  if (k + 1 === m) return Math.floor((3 * v[k] - v[Math.max(k - 1, 0)] + 2) / 4);
  const before = k > 0 ? v[k - 1] : v[1];
  const after = k + 2 < m ? v[k + 2] : v[m - 2];
  return Math.floor((9 * (v[k] + v[k + 1]) - before - after + 16) / 32);
}
