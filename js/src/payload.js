/** Payloads of units: mask, exceptions, remainders, own samples, corrections, heights (FORMAT.md §5). */

import { readVarint } from "./bytes.js";
import { decodeCorrections } from "./corrections.js";
import { require } from "./errors.js";
import { HAS_CORRECTIONS, HAS_FILLS, HAS_REMAINDERS } from "./header.js";
import { inflateZlib } from "./inflate.js";
import { decodeMask, decodeValidity, unmasked } from "./mask.js";

/**
 * Decode a unit: { unit, heights, valid, hasVoid, remainders, own }, of its region in raster order.
 *
 * `parent` is null for the root, else the parent heights: { rows, cols, heights, valid, hasVoid,
 * own, base, stride }. Remainders are null where all are 0, own where all valid samples are own, or
 * the file does not tell.
 */
export function decodePayload(file, unit, payload, parent) {
  const { header } = file;
  const n = unit.rows.n * unit.cols.n;
  if (payload.length === 0) {
    const nothing = { heights: new Int32Array(n), valid: new Uint8Array(n), remainders: null, own: null };
    return { unit, ...nothing, hasVoid: true };
  }
  const isFinest = unit.level === file.grid.kMax;
  const hasFills = (header.features & HAS_FILLS) !== 0;
  const flags = payload[0];
  const known = 3 | (header.features & HAS_REMAINDERS && isFinest ? 4 : 0) |
    (hasFills && !isFinest ? 8 : 0) | (header.features & HAS_CORRECTIONS ? 16 : 0);
  require((flags & ~known) === 0, "flags of a payload");
  const sections = [null, null, null, null, null];
  let at = 1;
  for (let bit = 0; bit < 5; bit++) {
    if (!((flags >> bit) & 1)) continue;
    const [length, start] = readVarint(payload, at);
    require(length >= 1 && length <= payload.length - start, "length of a section");
    at = start + length;
    sections[bit] = payload.subarray(start, at);
  }
  const [mask, exceptions, rest, ownMap, corrected] = sections;
  const mayHaveVoid = mask !== null || parent?.hasVoid === true || Boolean(parent?.own);
  const { valid, own } = hasFills && (mayHaveVoid || ownMap !== null)
    ? decodeValidity(mask, ownMap, unit, parent, isFinest)
    : { valid: mask ? decodeMask(mask, unit, parent) : unmasked(unit, parent), own: null };
  const hasVoid = mayHaveVoid && valid.includes(0);
  require(!hasVoid || valid.includes(1), "a payload of a unit without valid samples");
  const corrections = corrected && decodeCorrections(corrected, unit, parent !== null, header.step);
  const heights = file.decodeMethod(file, unit, payload.subarray(at), valid, parent, hasVoid,
    corrections);
  // Each height of rapid is within its limits (R.2), which are within these.
  if (header.method !== "rapid") clip(heights, header.zMin, header.zMax);
  moveFromNodata(file.quantaOfNodata, heights, valid, exceptions);
  const remainders = rest && decodeRemainders(rest, n, header.dtype.bytes);
  return { unit, heights, valid, remainders, hasVoid, own };
}

/** Step 1 of §5.1. */
function clip(heights, zMin, zMax) {
  for (let i = 0; i < heights.length; i++) {
    const height = heights[i];
    if (height < zMin) heights[i] = zMin;
    else if (height > zMax) heights[i] = zMax;
  }
}

/** Step 2 of §5.1: no valid sample keeps a height that is written as nodata. */
function moveFromNodata(taken, heights, valid, exceptions) {
  let nMet = 0;
  if (taken !== null) {
    const [a, b] = taken;
    for (let i = 0; i < heights.length; i++) {
      if (!valid[i] || heights[i] < a || heights[i] > b) continue;
      let isDown = 0;
      if (exceptions) {
        require(nMet >> 3 < exceptions.length, "length of the exception section");
        isDown = (exceptions[nMet >> 3] >> (7 - (nMet & 7))) & 1;
      }
      heights[i] = isDown ? a - 1 : b + 1;
      nMet++;
    }
  }
  if (exceptions === null) return;
  require(exceptions.length === Math.ceil(nMet / 8), "length of the exception section");
  const nFilled = -nMet & 7;
  require((exceptions.at(-1) & ((1 << nFilled) - 1)) === 0, "filling of the exception section");
}

/** §5.3: [low, high] 32 bits of each remainder, as Int32Array. */
function decodeRemainders(section, n, width) {
  const nPlanes = section[0];
  require(nPlanes >= 1 && nPlanes <= width, "bytes of a remainder");
  const data = inflateZlib(section.subarray(1), nPlanes * n);
  require(data.length === nPlanes * n, "length of the remainders");
  const low = new Int32Array(n);
  const high = new Int32Array(width === 8 ? n : 0);
  for (let plane = 0; plane < nPlanes; plane++) {
    const half = plane < 4 ? low : high;
    const shift = 8 * (plane & 3);
    for (let i = 0, from = plane * n; i < n; i++) half[i] |= data[from + i] << shift;
  }
  // Undo the zigzag: (z >> 1) ^ -(z & 1).
  for (let i = 0; i < n; i++) {
    const sign = -(low[i] & 1);
    const carried = width === 8 ? high[i] << 31 : 0;
    low[i] = ((low[i] >>> 1) | carried) ^ sign;
    if (width === 8) high[i] = (high[i] >>> 1) ^ sign;
  }
  return { low, high };
}
