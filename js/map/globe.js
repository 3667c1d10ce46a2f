/**
 * A terrain in longitude and latitude, heights in metres: as `terrainwave serve` has it.
 *
 * Between samples heights are bilinear; past the last sample of a coarse level they go on linearly.
 */

import { ArgumentError } from "../src/index.js";
import { Places } from "./places.js";

/**
 * `metres` per unit of height (negative where the file counts depths), `pixel` metres between
 * samples, `axis` of the ellipsoid.
 */
const NUMBERS = ["metres", "pixel", "axis", "error", "lowest", "highest"];

export class Globe {
  /** `described` is one entry of the terrains.json that `terrainwave publish` writes. */
  constructor(terrain, described) {
    const { placed } = described;
    const about = { ...described, ...placed };
    if (!placed || !NUMBERS.every((name) => Number.isFinite(about[name]))) {
      throw new ArgumentError("this terrain is not described as terrainwave publish does it");
    }
    for (const name of NUMBERS) this[name] = about[name];
    this.terrain = terrain;
    this.places = new Places(placed, terrain);
    this.extent = described.bounds;
    this.kMax = terrain.nLevels - 1;
  }

  /** Return the coarsest level whose samples are at most `spacing` metres apart. */
  levelFor(spacing) {
    const steps = Math.floor(Math.log2(Math.max((spacing / this.pixel) * (1 + 1e-6), 1)));
    return Math.max(this.kMax - steps, 0);
  }

  /**
   * Return { heights, window }: the bilinear heights of a level at places of `Places.toSamples`,
   * NaN where there are none, and what was read for them, null if nothing.
   */
  async heightsAt({ rows, cols }, level) {
    const heights = new Float64Array(rows.length).fill(NaN);
    const cells = new Cells(this, level, rows, cols);
    if (cells.count === 0) return { heights, window: null };
    const window = await cells.read();
    cells.interpolate(window, heights, this.scaling());
    return { heights, window };
  }

  scaling() {
    const { scale, offset } = this.terrain;
    return (raw) => (raw * scale + offset) * this.metres;
  }

  /** Return how far originals can be from the bilinear surface of what was read, in metres. */
  async heightsError({ level, parts, row, nRows }) {
    if (level === this.kMax) return this.error;
    const { blockSize } = this.terrain;
    const last = this.terrain.blockShape(level);
    const blockOf = (sample, n) => Math.min(Math.floor(sample / blockSize), n - 1);
    let largest = 0;
    for (const { col, nCols } of parts) {
      for (let i = blockOf(row, last.nRows); i <= blockOf(row + nRows - 1, last.nRows); i++) {
        for (let j = blockOf(col, last.nCols); j <= blockOf(col + nCols - 1, last.nCols); j++) {
          largest = Math.max(largest, await this.terrain.blockError(level, i, j));
        }
      }
    }
    return largest * Math.abs(this.metres);
  }
}

/** The cells of a level that places lie in. */
class Cells {
  constructor(globe, level, rows, cols) {
    this.terrain = globe.terrain;
    this.level = level;
    this.stride = 2 ** (globe.kMax - level);
    this.shape = this.terrain.shape(level);
    this.round = globe.places.goesRound ? globe.terrain.nCols / this.stride : null;
    this.top = new Int32Array(rows.length);
    this.left = new Int32Array(rows.length);
    this.right = new Int32Array(rows.length);
    this.down = new Float64Array(rows.length).fill(NaN);
    this.across = new Float64Array(rows.length);
    this.count = 0;
    for (let i = 0; i < rows.length; i++) if (!Number.isNaN(rows[i])) this.put(i, rows[i], cols[i]);
  }

  put(i, row, col) {
    const { nRows, nCols } = this.shape;
    const y = row / this.stride;
    this.top[i] = Math.min(Math.max(Math.floor(y), 0), Math.max(nRows - 2, 0));
    this.down[i] = nRows > 1 ? y - this.top[i] : 0;
    let x = col / this.stride;
    if (this.round === null) {
      this.left[i] = Math.min(Math.max(Math.floor(x), 0), Math.max(nCols - 2, 0));
      this.across[i] = nCols > 1 ? x - this.left[i] : 0;
      this.right[i] = Math.min(this.left[i] + 1, nCols - 1);
    } else {
      x -= this.round * Math.floor(x / this.round);
      const left = Math.min(Math.floor(x), nCols - 1);
      const isLast = left === nCols - 1;
      this.left[i] = left;
      this.across[i] = isLast ? (x - left) / (this.round - left) : x - left;
      this.right[i] = isLast ? 0 : left + 1;
    }
    this.count++;
  }

  /** Read the samples: one window, or two where columns are needed at both ends of a round. */
  async read() {
    const middle = this.round === null ? 0 : this.shape.nCols / 2;
    const halves = [[Infinity, -Infinity], [Infinity, -Infinity]];
    let [first, last] = [Infinity, -Infinity];
    for (let i = 0; i < this.top.length; i++) {
      if (Number.isNaN(this.down[i])) continue;
      first = Math.min(first, this.top[i]);
      last = Math.max(last, this.top[i] + 1);
      for (const col of [this.left[i], this.right[i]]) {
        const half = halves[col < middle ? 0 : 1];
        half[0] = Math.min(half[0], col);
        half[1] = Math.max(half[1], col);
      }
    }
    last = Math.min(last, this.shape.nRows - 1);
    const place = { row: first, nRows: last - first + 1 };
    const parts = await Promise.all(halves.filter(([low, high]) => low <= high).map(
      ([low, high]) => this.terrain.read(
        this.level, { ...place, col: low, nCols: high - low + 1 }, { voids: "any" },
      ),
    ));
    return { level: this.level, ...place, parts };
  }

  interpolate({ row, parts }, heights, toMetres) {
    const [one, other] = [parts[0], parts.at(-1)];
    const bottom = this.shape.nRows - 1;
    for (let i = 0; i < heights.length; i++) {
      const v = this.down[i];
      if (Number.isNaN(v)) continue;
      const u = this.across[i];
      let sum = 0;
      for (let corner = 0; corner < 4; corner++) {
        const weight = (corner & 2 ? v : 1 - v) * (corner & 1 ? u : 1 - u);
        if (weight === 0) continue;
        const col = corner & 1 ? this.right[i] : this.left[i];
        const part = col < other.col ? one : other;
        const y = Math.min(this.top[i] + (corner >> 1), bottom) - row;
        const at = y * part.nCols + col - part.col;
        if (!part.valid[at]) {
          sum = NaN;
          break;
        }
        sum += weight * toMetres(part.heights[at]);
      }
      heights[i] = sum;
    }
  }
}
