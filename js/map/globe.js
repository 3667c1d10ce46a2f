/**
 * A terrain in longitude and latitude, heights in metres: as `terrainwave serve` has it.
 *
 * Between samples heights are bilinear; past the last sample of a coarse level they go on linearly.
 */

import { ArgumentError } from "../src/index.js";
import { Places } from "./places.js";

/**
 * `metres` per unit of height (negative where the file counts depths), `pixel` metres between
 * samples, `axis` of the ellipsoid. With `radii` heights are distances from its centre.
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
    this.radii = about.radii === true;
    this.polarAxis = Number.isFinite(about.polar_axis) ? about.polar_axis : this.axis;
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
  async heightsAt({ rows, cols, lat }, level) {
    const heights = new Float64Array(rows.length).fill(NaN);
    const cells = new Cells(this, level, rows, cols);
    if (cells.count === 0) return { heights, window: null };
    const window = await cells.read();
    cells.interpolate(window, heights);
    if (this.radii) this.#fromRadii(heights, lat);
    return { heights, window };
  }

  /** Make heights above the ellipsoid of distances from its centre, row by row of latitudes. */
  #fromRadii(heights, lat) {
    const nLon = heights.length / lat.length;
    const e2 = 1 - (this.polarAxis / this.axis) ** 2;
    for (let i = 0; i < heights.length; i++) {
      const sine = Math.sin((lat[Math.floor(i / nLon)] * Math.PI) / 180) ** 2;
      const shrunk = 1 - e2 * sine;
      const normal = this.axis * Math.sqrt(shrunk);
      const beyond = heights[i] ** 2 - (this.axis ** 2 * (1 - sine * (2 * e2 - e2 ** 2))) / shrunk;
      heights[i] = beyond / (normal + Math.sqrt(normal ** 2 + beyond));
    }
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
    Object.assign(this, { globe, level, rows, cols, terrain: globe.terrain });
    this.stride = 2 ** (globe.kMax - level);
    this.shape = this.terrain.shape(level);
    this.round = globe.places.goesRound ? globe.terrain.nCols / this.stride : null;
    this.count = rows.reduce((n, row) => n + (row === row), 0);
  }

  /** Return the first column of a place's cell, its second one, and how far across the cell the place is. */
  across(col) {
    const { nCols } = this.shape;
    let x = col / this.stride;
    if (this.round === null) {
      const left = Math.min(Math.max(Math.floor(x), 0), Math.max(nCols - 2, 0));
      return [left, Math.min(left + 1, nCols - 1), nCols > 1 ? x - left : 0];
    }
    x -= this.round * Math.floor(x / this.round);
    const left = Math.min(Math.floor(x), nCols - 1);
    if (left < nCols - 1) return [left, left + 1, x - left];
    return [left, 0, (x - left) / (this.round - left)];
  }

  /** Read the samples: one window, or two where columns are needed at both ends of a round. */
  async read() {
    const { rows, cols, shape } = this;
    const [low, high] = rangeOf(rows);
    const lastTop = Math.max(shape.nRows - 2, 0);
    const topOf = (row) => Math.min(Math.max(Math.floor(row / this.stride), 0), lastTop);
    const first = topOf(low);
    const last = Math.min(topOf(high) + 1, shape.nRows - 1);
    const halves = [[Infinity, -Infinity], [Infinity, -Infinity]];
    const need = (half, col) => {
      half[0] = Math.min(half[0], col);
      half[1] = Math.max(half[1], col);
    };
    if (this.round === null) {
      for (const end of rangeOf(cols)) this.across(end).slice(0, 2).forEach((col) => need(halves[0], col));
    } else {
      const middle = shape.nCols / 2;
      for (let i = 0; i < cols.length; i++) {
        if (Number.isNaN(cols[i])) continue;
        this.across(cols[i]).slice(0, 2).forEach((col) => need(halves[col < middle ? 0 : 1], col));
      }
    }
    const place = { row: first, nRows: last - first + 1 };
    const parts = await Promise.all(halves.filter(([from, to]) => from <= to).map(
      ([from, to]) => this.terrain.read(
        this.level, { ...place, col: from, nCols: to - from + 1 }, { voids: "any" },
      ),
    ));
    return { level: this.level, ...place, parts };
  }

  /** The innermost loops of tiles: hence no function is called for each place of a plain raster. */
  interpolate({ row, parts }, heights) {
    const { rows, cols, stride, round } = this;
    const { nRows, nCols } = this.shape;
    const { scale, offset } = this.terrain;
    const { metres } = this.globe;
    const [one, other] = [parts[0], parts.at(-1)];
    const [lastTop, lastLeft] = [Math.max(nRows - 2, 0), Math.max(nCols - 2, 0)];
    const [down, right1] = [nRows > 1 ? 1 : 0, nCols > 1 ? 1 : 0];
    for (let i = 0; i < heights.length; i++) {
      if (Number.isNaN(rows[i])) continue;
      const y = rows[i] / stride;
      const top = Math.min(Math.max(Math.floor(y), 0), lastTop);
      const v = down ? y - top : 0;
      let [left, right, u] = [0, 0, 0];
      if (round === null) {
        const x = cols[i] / stride;
        left = Math.min(Math.max(Math.floor(x), 0), lastLeft);
        right = left + right1;
        u = right1 ? x - left : 0;
      } else {
        [left, right, u] = this.across(cols[i]);
      }
      const [west, east] = [left < other.col ? one : other, right < other.col ? one : other];
      const a = (top - row) * west.nCols + left - west.col;
      const b = (top - row) * east.nCols + right - east.col;
      const [c, d] = [a + down * west.nCols, b + down * east.nCols];
      // A sample of weight 0 does not count, valid or not.
      let sum = 0;
      const [ofA, ofB, ofC, ofD] = [(1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u];
      if (ofA !== 0) sum = west.valid[a] ? ofA * ((west.heights[a] * scale + offset) * metres) : NaN;
      if (ofB !== 0) sum = east.valid[b] ? sum + ofB * ((east.heights[b] * scale + offset) * metres) : NaN;
      if (ofC !== 0) sum = west.valid[c] ? sum + ofC * ((west.heights[c] * scale + offset) * metres) : NaN;
      if (ofD !== 0) sum = east.valid[d] ? sum + ofD * ((east.heights[d] * scale + offset) * metres) : NaN;
      heights[i] = sum;
    }
  }
}

/** Return the least and the greatest number of those that are numbers. */
function rangeOf(numbers) {
  let [low, high] = [Infinity, -Infinity];
  for (let i = 0; i < numbers.length; i++) {
    if (numbers[i] < low) low = numbers[i];
    if (numbers[i] > high) high = numbers[i];
  }
  return [low, high];
}
