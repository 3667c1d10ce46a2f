/** Shared samples of a group: corner samples, then lines (R.3; P.3 of format-predictive.md). */

const MOST_CORNERS = 64;
const CLASS_ROW = 3; // of features

/** Return the region's lines near each shared side of an axis. */
export function sharedLines(axis, rings) {
  const sides = [axis.core, axis.core + axis.nCore - 1].filter((_, i) => axis.isShared[i]);
  return sides.map((side) => {
    const lines = [];
    for (let line = side - rings; line <= side + rings; line++) {
      if (line >= 0 && line < axis.n) lines.push(line);
    }
    return lines;
  });
}

/** Return [before, after]: of an axis's line, the parent's lines at or before, at or after it. */
export function parentLines(axis, parentAxis, line) {
  const place = axis.first + line;
  const after = Math.min((place + 1) >>> 1, parentAxis.last);
  return [(place >>> 1) - parentAxis.first, after - parentAxis.first];
}

/** Decodes what is shared, into the heights of a region; `known` notes where. */
export class SharedRows {
  constructor(coder, unit, parent, heights, valid, rings) {
    Object.assign(this, { coder, unit, parent, heights, valid, rings });
    this.known = new Uint8Array(heights.length);
    this.features = coder.features[CLASS_ROW];
  }

  /** Return a parent's sample, as it is read: clamped, less the origin. */
  above(row, col) {
    const { parent, coder } = this;
    return coder.inside(parent.heights[parent.base + row * parent.stride + col]);
  }

  isOdd(row, col) {
    const { rows, cols } = this.unit;
    return ((rows.first + row) | (cols.first + col)) & 1;
  }

  decode() {
    const { rows, cols } = this.unit;
    const rowSides = sharedLines(rows, this.rings);
    const colSides = sharedLines(cols, this.rings);
    this.decodeCorners(rowSides, colSides);
    for (const row of new Set(rowSides.flat())) {
      const [before, after] = parentLines(rows, this.parent.rows, row);
      const [first] = parentLines(cols, this.parent.cols, cols.core);
      this.decodeLine(row * cols.n + cols.core, 1, cols.nCore, (rows.first + row) & 1,
        (k) => this.above(before, first + k), (k) => this.above(after, first + k));
    }
    for (const col of new Set(colSides.flat())) {
      const [before, after] = parentLines(cols, this.parent.cols, col);
      const [first] = parentLines(rows, this.parent.rows, rows.core);
      this.decodeLine(rows.core * cols.n + col, cols.n, rows.nCore, (cols.first + col) & 1,
        (k) => this.above(first + k, before), (k) => this.above(first + k, after));
    }
  }

  decodeCorners(rowSides, colSides) {
    const { rows, cols } = this.unit;
    const coded = [];
    for (const side of rowSides) {
      for (const other of colSides) {
        for (const row of side) {
          for (const col of other) {
            const place = row * cols.n + col;
            if (this.known[place]) continue;
            this.known[place] = 1;
            const [top, bottom] = parentLines(rows, this.parent.rows, row);
            const [left, right] = parentLines(cols, this.parent.cols, col);
            if (!this.isOdd(row, col)) {
              this.heights[place] = this.above(top, left) + this.coder.origin;
              continue;
            }
            const core = [
              this.above(top, left), this.above(top, right),
              this.above(bottom, left), this.above(bottom, right),
            ];
            coded.push({ place, core });
          }
        }
      }
    }
    const { workspace: m } = this.coder;
    for (let first = 0; first < coded.length; first += MOST_CORNERS) {
      const row = coded.slice(first, first + MOST_CORNERS);
      row.forEach(({ core: [a, b, c, d] }, j) => {
        this.set(m, j, Math.min(a, b, c, d), Math.max(a, b, c, d), a + b + c + d,
          16 * (a + b + c + d), Math.abs(a - b - c + d));
      });
      this.decodeRow(Int32Array.from(row, ({ place }) => place));
    }
  }

  set(m, j, least, most, sum, predicted, twist) {
    m.least[j] = least;
    m.most[j] = most;
    m.sum[j] = sum;
    m.predicted[j] = predicted;
    m.twist[j] = twist;
    m.expected[j] = 0;
  }

  /** `before(k)` and `after(k)` are the parent's samples beside the line's place 2k. */
  decodeLine(start, step, length, isOdd, before, after) {
    const { known, heights, coder } = this;
    const { workspace: m } = coder;
    const n = (length + 1) >> 1;
    // Both with what stands for places outside: index k is at k + 1.
    const { line, lineOf: first } = m;
    for (let k = 0; k < n; k++) {
      first[k] = before(k);
      line[k + 1] = isOdd ? first[k] + after(k) : first[k];
    }
    this.extend(line, n);
    const unknown = (parity) => {
      const places = [];
      for (let k = parity; k < length; k += 2) if (!known[start + k * step]) places.push(k);
      return places;
    };
    const even = unknown(0);
    const odd = unknown(1);
    if (isOdd) {
      even.forEach((place, j) => {
        const k = place >> 1;
        const [u, t] = [first[k], line[k + 1]];
        this.set(m, j, Math.min(u, t - u), Math.max(u, t - u), 2 * t, 32 * t,
          Math.abs(line[k] - 2 * t + line[k + 2]));
      });
      this.decodeRow(Int32Array.from(even, (place) => start + place * step));
      for (let k = 0; k < n; k++) line[k + 1] = heights[start + 2 * k * step] - coder.origin;
      this.extend(line, n);
    } else {
      for (const place of even) {
        heights[start + place * step] = line[(place >> 1) + 1] + coder.origin;
        known[start + place * step] = 1;
      }
      for (let k = 0; k < n; k++) line[k + 1] = heights[start + 2 * k * step] - coder.origin;
      this.extend(line, n);
    }
    odd.forEach((place, j) => {
      const k = place >> 1;
      const [a, b, c, d] = [line[k], line[k + 1], line[k + 2], line[k + 3]];
      this.set(m, j, Math.min(a, b, c, d), Math.max(a, b, c, d), 2 * (b + c),
        4 * (9 * (b + c) - a - d), Math.abs(a - b - c + d));
    });
    this.decodeRow(Int32Array.from(odd, (place) => start + place * step));
  }

  extend(line, n) {
    line[0] = line[1 + Math.min(1, n - 1)];
    line[n + 1] = line[1 + Math.max(n - 2, 0)];
    line[n + 2] = line[1 + Math.max(n - 3, 0)];
  }

  /** Decode a row of samples that is predicted in the workspace. */
  decodeRow(places) {
    const { coder, valid, heights, known } = this;
    const { workspace: m } = coder;
    const n = places.length;
    if (n === 0) return;
    coder.arithmetic.fillContexts(m, n, this.features, coder.scale);
    for (let j = 0; j < n; j++) m.valid[j] = valid[places[j]];
    coder.readLine(n);
    coder.fillHeights(m.result, 0, 0, n);
    coder.correct(m.result, 0, 0, n, (j) => places[j]);
    for (let j = 0; j < n; j++) {
      heights[places[j]] = m.result[j] + coder.origin;
      known[places[j]] = 1;
    }
  }
}

