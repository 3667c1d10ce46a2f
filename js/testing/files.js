/** Golden files, and files made of them. */

import { randomBytes } from "node:crypto";
import { readFile } from "node:fs/promises";
import { deflateRawSync, deflateSync, inflateSync } from "node:zlib";

import { crc32 } from "../site/files.js";
import { TerrainwaveError, open } from "../src/index.js";
import { fileOrder, keysOf, lengthsOf } from "./format.js";

export const GOLDEN = new URL("../../tests/golden/v2/", import.meta.url);

export const golden = (name) => readFile(new URL(`${name}.twz`, GOLDEN));

/** The parts of a file of one segment, and a file of parts with all lengths and checksums mended. */
export class Parts {
  constructor(bytes) {
    const sizes = [128, ...lengthsOf(bytes)];
    let at = 0;
    [this.header, this.metadata, this.parameters, this.page] = sizes.map((size) => {
      at += size;
      return Uint8Array.from(bytes.subarray(at - size, at));
    });
    this.columns = inflateSync(this.page.subarray(12));
    const keys = keysOf(bytes);
    this.nKeys = keys.length;
    this.payloads = new Array(keys.length);
    for (const i of fileOrder(keys)) {
      const n = this.column(0, i);
      this.payloads[i] = Uint8Array.from(bytes.subarray(at, at + n));
      at += n + this.column(4 * this.nKeys, i);
    }
    this.order = fileOrder(keys);
  }

  column(start, i) {
    return [3, 2, 1, 0].reduce((n, p) => n * 256 + this.columns[start + p * this.nKeys + i], 0);
  }

  setColumn(start, i, value) {
    for (let p = 0; p < 4; p++) this.columns[start + p * this.nKeys + i] = value >>> (8 * p);
  }

  /** Return a file without meshes. */
  bytes() {
    const crcColumn = this.columns.length - 8 * this.nKeys;
    this.payloads.forEach((payload, i) => {
      this.setColumn(0, i, payload.length);
      this.setColumn(4 * this.nKeys, i, 0);
      this.setColumn(crcColumn, i, crc32(payload));
      this.setColumn(crcColumn + 4 * this.nKeys, i, 0);
    });
    const page = Buffer.concat([this.page.subarray(0, 12), deflateSync(this.columns)]);
    page.writeUInt32LE(crc32(page.subarray(4)), 0);
    const header = Buffer.from(this.header);
    const payloads = this.order.map((i) => this.payloads[i]);
    const sections = [this.metadata, this.parameters, page, ...payloads];
    const size = sections.reduce((n, section) => n + section.length, 128);
    header.writeBigUInt64LE(BigInt(size), 16);
    header.writeUInt32LE(this.metadata.length, 76);
    header.writeUInt32LE(crc32(this.metadata), 104);
    header.writeUInt32LE(this.parameters.length, 108);
    header.writeUInt32LE(crc32(this.parameters), 112);
    header.writeUInt32LE(page.length, 116);
    header.writeUInt32LE(crc32(header.subarray(0, 124)), 124);
    return new Uint8Array(Buffer.concat([header, ...sections]));
  }
}

/** Return a golden file with so much metadata that its head takes two requests, its heights another. */
export async function withLongHead(name) {
  const parts = new Parts(await golden(name));
  const text = JSON.stringify({ tags: { noise: randomBytes(30000).toString("hex") } });
  parts.metadata = deflateRawSync(Buffer.from(text));
  return parts.bytes();
}

/** Return a small generator of numbers below n, the same ones for a seed. */
export function random(seed) {
  let state = seed >>> 0;
  return (n) => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return Math.floor((state / 2 ** 32) * n);
  };
}

/** Read the `nLevels` finest levels; return why bytes are refused by an error of ours, or "" where all is accepted. */
export async function refusal(bytes, nLevels = Infinity) {
  let terrain;
  try {
    terrain = await open(bytes, { maxSamples: 2 ** 20 });
    for (let level = Math.max(0, terrain.nLevels - nLevels); level < terrain.nLevels; level++) {
      const { nRows, nCols, heights, valid } = await terrain.read(level);
      if (heights.length !== nRows * nCols || valid.length !== heights.length) {
        throw new Error(`${heights.length} heights, ${valid.length} valid, ${nRows} x ${nCols}`);
      }
      if (heights.some((height, i) => valid[i] && !Number.isFinite(height))) throw new Error("a height is not finite");
    }
    return "";
  } catch (error) {
    if (!(error instanceof TerrainwaveError) || error.message.includes("broke off")) throw error;
    return error.message.replace(/[\d.-]+/g, "0");
  } finally {
    await terrain?.close(); // another file gets the memory as this one leaves it
  }
}
