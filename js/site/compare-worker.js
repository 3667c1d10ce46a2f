/** Compares bands of a file and its original in a thread of its own: { id, what, question } is answered by id. */

import { open } from "../src/index.js";
import { answer } from "../src/mailbox.js";
import { Comparison } from "./compare.js";
import { Original } from "./original.js";

/** Samples on a side of a tile that has a digest (FORMAT.md §4.9). */
const TILE = 512;
/** Columns that are read at once: they need memory in every worker. A strip is decoded anew for each part of it. */
const [MOST_COLS, MOST_OF_STRIPS] = [4 * TILE, 32 * TILE];
let terrain = null;
let original = null;

export const WORK = {
  /** Open both; return what the page has to know. */
  async open({ twz, tif, band, cacheBytes }) {
    terrain = await open(twz, { cacheBytes, workers: 0 });
    original = await Original.open(tif, band);
    const { dtype, method, maxError, effectiveBound, rawRho, scale, boundSide, heightsAre, crs, nRows, nCols } = terrain;
    // Bands of whole tiles of the GeoTIFF: it decodes none twice.
    const rows = TILE * Math.ceil(original.tileRows / TILE);
    return {
      file: { dtype, method, maxError, effectiveBound, rawRho, scale, boundSide, heightsAre, crs },
      nRows, nCols, rows, nodata: original.nodata, ...original.problems(terrain),
      stated: await terrain.statedRoot(),
    };
  },

  /** Compare rows; return sums, and digests of their tiles, row by row. */
  async band({ row, nRows }) {
    const comparison = new Comparison(terrain, original.nodata);
    const nTileCols = Math.ceil(terrain.nCols / TILE);
    const digests = new Uint8Array(32 * Math.ceil(nRows / TILE) * nTileCols);
    const most = original.isTiled ? MOST_COLS : MOST_OF_STRIPS;
    for (let col = 0; col < terrain.nCols; col += most) {
      const nCols = Math.min(most, terrain.nCols - col);
      const source = await original.read({ row, col, nRows, nCols });
      for (let at = 0; at < nRows; at += TILE) {
        const part = { row: row + at, col, nRows: Math.min(TILE, nRows - at), nCols };
        const { heights, valid } = await terrain.read(-1, part);
        const of = (array) => array.subarray(at * nCols, (at + part.nRows) * nCols);
        comparison.add(part, of(source.heights), of(source.valid), heights, valid);
        for (let left = 0; left < nCols; left += TILE) {
          const tile = cut({ heights, valid, nCols, nRows: part.nRows }, left, Math.min(TILE, nCols - left));
          digests.set(await terrain.digest(tile), 32 * ((at / TILE) * nTileCols + (col + left) / TILE));
        }
      }
    }
    return { found: comparison.found, digests };
  },

  root(digests) {
    return terrain.rootOf(digests);
  },
};

/** Return columns of a window. */
function cut({ heights, valid, nRows, nCols: width }, left, nCols) {
  const [own, ownValid] = [new heights.constructor(nRows * nCols), new Uint8Array(nRows * nCols)];
  for (let row = 0; row < nRows; row++) {
    const from = row * width + left;
    own.set(heights.subarray(from, from + nCols), row * nCols);
    ownValid.set(valid.subarray(from, from + nCols), row * nCols);
  }
  return { heights: own, valid: ownValid, nRows, nCols };
}

/** Say which of the two files an error is of: that of the .twz file has a name of ours. */
function fail(error) {
  if (!["CorruptStreamError", "UnsupportedError", "SourceError"].includes(error.name)) throw error;
  throw Object.assign(error, { message: `the .twz file cannot be read: ${error.message}` });
}

globalThis.onmessage = ({ data: { id, what, question } }) =>
  answer(globalThis, id, () => WORK[what](question).catch(fail));
