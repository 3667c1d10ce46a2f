/** A lattice of method predictive: its samples, and what is read outside (P.5, P.6). */

export const REACH = 5; // lattice places farther outside are never read
export const [HH, HL, LH] = [0, 1, 2];
export const PARITY = [[1, 1], [0, 1], [1, 0]];
const MOST_BEND = 2 ** 31 - 1;

/** Whole-sample symmetry about 0 and n - 1, repeated until inside. */
function fold(i, n) {
  const period = 2 * (n - 1);
  if (period === 0) return 0;
  const inside = ((i % period) + period) % period;
  return Math.min(inside, period - inside);
}

/** Return, by place with margins of REACH, the place inside that it stands for. */
function folded(n) {
  return Int32Array.from({ length: n + 2 * REACH }, (_, i) => fold(i - REACH, n));
}

/** Arrays of n zeros; values are whole numbers whose products need more than 32 bits. */
export const newArrays = (n) => ({
  values: new Float64Array(n), errors: new Int32Array(n), activity: new Int32Array(n),
  bends: new Float64Array(n),
});

/** Samples of a lattice, and what is known of planes coded before, with margins of REACH. */
export class Lattice {
  constructor(unit, stride, heights, arrays = newArrays) {
    Object.assign(this, { unit, stride, heights });
    this.nRows = Math.floor((unit.rows.nCore - 1) / stride) + 1;
    this.nCols = Math.floor((unit.cols.nCore - 1) / stride) + 1;
    this.pitch = this.nCols + 2 * REACH;
    Object.assign(this, arrays((this.nRows + 2 * REACH) * this.pitch));
    this.rowsOf = folded(this.nRows);
    this.colsOf = folded(this.nCols);
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

  isEmpty([down, right]) {
    return (down && this.nRows === 1) || (right && this.nCols === 1);
  }

  load() {
    const { heights, values, stride } = this;
    for (let r = 0; r < this.nRows; r += 2) {
      let from = this.place(r, 0);
      const to = this.at(r, 0);
      for (let c = 0; c < this.nCols; c += 2, from += 2 * stride) values[to + c] = heights[from];
    }
    this.mirror(values, [0, 0]);
    for (const parity of PARITY) if (this.isEmpty(parity)) this.fillMeans(parity);
  }

  /** Fill an empty plane, which is read all the same. */
  fillMeans([down, right]) {
    const { heights, values } = this;
    const coarse = (r, c) => heights[this.place(fold(r, this.nRows), fold(c, this.nCols))];
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

  /** Curvatures of plane A (P.6). */
  fillBends() {
    const { values: a, bends, pitch } = this;
    for (let r = 0; r < this.nRows; r += 2) {
      const first = this.at(r, 0);
      for (let i = first; i < first + this.nCols; i += 2) {
        const across = a[i - 4] - 4 * a[i - 2] + 6 * a[i] - 4 * a[i + 2] + a[i + 4];
        const along = a[i - 4 * pitch] - 4 * a[i - 2 * pitch] + 6 * a[i] - 4 * a[i + 2 * pitch] +
          a[i + 4 * pitch];
        bends[i] = Math.min(Math.abs(across) + Math.abs(along), MOST_BEND);
      }
    }
    this.mirror(bends, [0, 0]);
  }

  /** Make a plane of an array readable outside. */
  mirror(array, [down, right]) {
    const { rowsOf, colsOf, pitch, nRows, nCols } = this;
    const firstCol = right ^ (REACH & 1);
    const afterLast = REACH + nCols + ((REACH + nCols + firstCol) & 1);
    for (let r = down; r < nRows; r += 2) {
      const at = (r + REACH) * pitch;
      for (let c = firstCol; c < REACH; c += 2) array[at + c] = array[at + REACH + colsOf[c]];
      for (let c = afterLast; c < pitch; c += 2) array[at + c] = array[at + REACH + colsOf[c]];
    }
    for (let r = down ^ (REACH & 1); r < rowsOf.length; r += 2) {
      if (r >= REACH && r < REACH + nRows) continue;
      const to = r * pitch;
      const from = (rowsOf[r] + REACH) * pitch;
      for (let c = firstCol; c < pitch; c += 2) array[to + c] = array[from + c];
    }
  }

  /** Make a plane that has been coded readable outside. */
  surround(parity) {
    this.mirror(this.values, parity);
    this.mirror(this.errors, parity);
    this.mirror(this.activity, parity);
  }
}
