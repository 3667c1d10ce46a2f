/** Method store (FORMAT.md §8). */

import { viewOf } from "./bytes.js";
import { require } from "./errors.js";

export function decodeStore(file, unit, payload, valid, parent) {
  const { zMin, zMax, step } = file.header;
  const { rows, cols } = unit;
  const heights = new Int32Array(rows.n * cols.n);
  require(payload.length >= 5, "a payload of store is cut off");
  const low = viewOf(payload).getInt32(0, true);
  const nBits = payload[4];
  require(nBits <= 31, "n_bits");
  const bytes = payload.subarray(5);
  const unitOfBits = 2 ** nBits;
  let held = 0; // fewer than 8 + nBits bits: a double holds them exactly
  let nHeld = 0;
  let at = 0;
  let nStored = 0;
  for (let r = 0, i = 0; r < rows.n; r++) {
    const row = rows.first + r;
    for (let c = 0; c < cols.n; c++, i++) {
      const col = cols.first + c;
      if (parent !== null && row % 2 === 0 && col % 2 === 0) {
        const above = (row / 2 - parent.rows.first) * parent.stride + col / 2 - parent.cols.first;
        heights[i] = parent.heights[parent.base + above];
      } else if (valid[i]) {
        nStored++;
        for (; nHeld < nBits; nHeld += 8) held = held * 256 + (at < bytes.length ? bytes[at++] : 0);
        const rest = 2 ** (nHeld - nBits);
        const index = Math.floor(held / rest);
        held -= index * rest;
        nHeld -= nBits;
        const height = zMin + (low + (index % unitOfBits)) * step + (step - 1) / 2;
        heights[i] = Math.min(Math.max(height, zMin), zMax);
      }
    }
  }
  require(bytes.length === Math.ceil((nBits * nStored) / 8), "length of a payload of store");
  return heights;
}
