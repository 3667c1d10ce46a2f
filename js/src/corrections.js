/** Corrections: heights that are put back while a unit is decoded (FORMAT.md §5.5). */

import { bitLength } from "./bytes.js";
import { require } from "./errors.js";
import { Models, RangeDecoder } from "./rangecoder.js";

const PIECE = 32; // samples of a row
const [SAMPLES, SIZES, PREFIX, N_MODELS] = [16, 124, 138, 170];
const MOST = 2 ** 31 - 1;

/** Return the corrections of the samples of a unit's region, in raster order. */
export function decodeCorrections(section, { rows, cols }, isGroup, step) {
  const decoder = new RangeDecoder(section);
  const models = new Models(N_MODELS);
  const low = Math.max(bitLength(step) - 5, 0);
  // Two rows and columns before the region, one column after it.
  const pitch = cols.n + 3;
  const found = new Int32Array((rows.n + 2) * pitch);
  const nPieces = Math.ceil(cols.n / PIECE);
  const has = new Uint8Array((rows.n + 2) * (nPieces + 1));
  const is = (at) => (found[at] !== 0 ? 1 : 0);
  let any = false;
  for (let row = 0; row < rows.n; row++) {
    const p = (rows.first + row) & 1;
    for (let piece = 0; piece < nPieces; piece++) {
      const here = (row + 2) * (nPieces + 1) + piece + 1;
      const above = here - nPieces - 1;
      const model = 8 * p + 4 * has[here - 1] + 2 * has[above] + has[above - nPieces - 1];
      has[here] = decoder.bit(models, model);
      if (!has[here]) continue;
      const last = Math.min((piece + 1) * PIECE, cols.n);
      for (let col = piece * PIECE; col < last; col++) {
        const q = (cols.first + col) & 1;
        if (isGroup && !p && !q) continue;
        const at = (row + 2) * pitch + col + 2;
        const west = is(at - 1) + is(at - 2);
        const north = is(at - pitch) + is(at - 2 * pitch);
        const beside = is(at - pitch - 1) + is(at - pitch + 1);
        if (!decoder.bit(models, SAMPLES + 27 * (2 * p + q) + 9 * west + 3 * north + beside)) continue;
        const sign = decoder.raw(1) ? -1 : 1;
        const size = 1 + decoder.magnitude(models, SIZES, PREFIX, low);
        require(size <= MOST, "a correction");
        found[at] = sign * size;
        any = true;
      }
    }
  }
  decoder.end();
  require(any, "corrections that are all 0");
  const corrections = new Int32Array(rows.n * cols.n);
  for (let row = 0; row < rows.n; row++) {
    const from = (row + 2) * pitch + 2;
    corrections.set(found.subarray(from, from + cols.n), row * cols.n);
  }
  return corrections;
}

/** Return a height with the correction of a place, if there are any. */
export function corrected(corrections, place, height, low, high) {
  return corrections === null ? height : Math.min(Math.max(height + corrections[place], low), high);
}
