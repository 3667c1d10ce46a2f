/**
 * Places of longitudes and latitudes in a raster of any coordinate reference system.
 *
 * `terrainwave publish` fits a polynomial to what PROJ says, and measures how far it is off: here
 * it is only evaluated. Chebyshev polynomials of both axes, coefficients by rows of latitude.
 */

import { ArgumentError } from "../src/index.js";

/** Of a pixel: what rounding may put beyond the raster's edge. */
const AT_EDGE = 1e-6;
const MOST_TERMS = 256;

const modulo = (value, by) => value - by * Math.floor(value / by);

/** Return T_0 … T_{n-1} of a place between `low` and `high`. */
function basis(place, low, high, n) {
  const at = (2 * place - low - high) / (high - low);
  const values = [1, at];
  for (let i = 2; i < n; i++) values.push(2 * at * values[i - 1] - values[i - 2]);
  return values.slice(0, n);
}

function checkTable(table) {
  const isTable = Array.isArray(table) && table.length > 0 && table.length <= MOST_TERMS &&
    table.every((line) => Array.isArray(line) && line.length > 0 && line.length <= MOST_TERMS &&
      line.length === table[0].length && line.every(Number.isFinite));
  if (!isTable) throw new ArgumentError("places: rows and cols are tables of numbers");
}

export class Places {
  /** `fitted` is what `terrainwave publish` writes; `terrain` tells the raster's size. */
  constructor({ domain, rows, cols, turn, goes_round: goesRound }, { nRows, nCols }) {
    checkTable(rows);
    checkTable(cols);
    const isDomain = Array.isArray(domain) && domain.length === 4 && domain.every(Number.isFinite);
    if (!isDomain || domain[0] >= domain[2] || domain[1] >= domain[3]) {
      throw new ArgumentError("places: domain is west, south, east, north");
    }
    Object.assign(this, { domain, rows, cols, nRows, nCols });
    this.turn = turn ?? null; // columns of 360 degrees
    this.goesRound = goesRound === true;
  }

  /**
   * Return { rows, cols, lat }: fractional samples of the full grid at all pairs of `lat` and
   * `lon`, row by row; NaN outside the raster's pixels.
   */
  toSamples(lon, lat) {
    const [west, south, east, north] = this.domain;
    const rows = new Float64Array(lon.length * lat.length).fill(NaN);
    const cols = new Float64Array(lon.length * lat.length).fill(NaN);
    const across = Array.from(lon, (degrees) => {
      const place = west + modulo(degrees - west, 360);
      return place <= east ? basis(place, west, east, this.nLon) : null;
    });
    // Of many rasters, rows follow from the latitude alone, and columns from the longitude.
    const [isRowOfLat, isColOfLon] = [this.rows[0].length === 1, this.cols.length === 1];
    const colsOfLon = isColOfLon && across.map((terms) => terms && this.column(product(this.cols[0], terms)));
    for (let i = 0; i < lat.length; i++) {
      if (!(lat[i] >= south && lat[i] <= north)) continue;
      const down = basis(lat[i], south, north, Math.max(this.rows.length, this.cols.length));
      const [ofRow, ofCol] = [this.rows, this.cols].map((table) => along(table, down));
      const rowOfLat = isRowOfLat && this.clamped(ofRow[0], this.nRows);
      for (let j = 0; j < lon.length; j++) {
        if (across[j] === null) continue;
        const row = isRowOfLat ? rowOfLat : this.clamped(product(ofRow, across[j]), this.nRows);
        const col = isColOfLon ? colsOfLon[j] : this.column(product(ofCol, across[j]));
        if (row === null || col === null) continue;
        rows[i * lon.length + j] = row;
        cols[i * lon.length + j] = col;
      }
    }
    return { rows, cols, lat };
  }

  get nLon() {
    return Math.max(this.rows[0].length, this.cols[0].length);
  }

  column(place) {
    if (this.goesRound) return place;
    if (this.turn === null) return this.clamped(place, this.nCols);
    const start = (this.nCols - 1 - this.turn) / 2;
    return this.clamped(start + modulo(place - start, this.turn), this.nCols);
  }

  /** The outermost half pixel is the outermost sample's. */
  clamped(place, n) {
    if (!(place >= -0.5 - AT_EDGE && place <= n - 0.5 + AT_EDGE)) return null;
    return Math.min(Math.max(place, 0), n - 1);
  }
}

/** Return the coefficients along a line of latitude. */
function along(table, down) {
  const found = new Float64Array(table[0].length);
  table.forEach((line, i) => line.forEach((value, j) => { found[j] += value * down[i]; }));
  return found;
}

function product(coefficients, values) {
  let sum = 0;
  for (let i = 0; i < coefficients.length; i++) sum += coefficients[i] * values[i];
  return sum;
}
