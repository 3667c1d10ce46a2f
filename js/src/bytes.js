/** Numbers in bytes (FORMAT.md §1.3, §1.4). */

import { require } from "./errors.js";

const CRC_TABLE = new Int32Array(256);
for (let i = 0; i < 256; i++) {
  let crc = i;
  for (let k = 0; k < 8; k++) crc = crc & 1 ? (crc >>> 1) ^ 0xedb88320 : crc >>> 1;
  CRC_TABLE[i] = crc;
}

/** Return the CRC-32 of bytes, 0 … 2^32 - 1. */
export function crc32(bytes) {
  let crc = -1;
  for (let i = 0; i < bytes.length; i++) crc = CRC_TABLE[(crc ^ bytes[i]) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

/** Return a DataView of exactly these bytes. */
export function viewOf(bytes) {
  return new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
}

/** Return [value, place after it] of the varint at a place (§1.4). */
export function readVarint(bytes, at) {
  let value = 0;
  let unit = 1; // not shifts: a varint has up to 35 bits
  for (let i = 0; i < 5; i++, unit *= 128) {
    require(at + i < bytes.length, "varint is cut off");
    const byte = bytes[at + i];
    value += (byte & 127) * unit;
    if (byte < 128) {
      require(byte > 0 || i === 0, "varint is longer than it must be");
      return [value, at + i + 1];
    }
  }
  throw require(false, "varint has a sixth byte");
}

/** Return the number of binary digits of a whole number 0 … 2^32 - 1. */
export function bitLength(value) {
  return 32 - Math.clz32(value);
}
