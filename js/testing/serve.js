/**
 * Answer lines of standard input, JSON { what, path, window }, by lines of JSON: `digests` of a
 * file's levels, or what `terrainwave` or `geotiff` took to open a file in memory and to read a
 * window of it, or all: processor seconds of all threads, and the SHA-256 of the heights.
 */

import { createHash, webcrypto } from "node:crypto";
import { readFile } from "node:fs/promises";
import { createInterface } from "node:readline";

import { open } from "../src/index.js";
import { levelDigests } from "./levels.js";

globalThis.crypto ??= webcrypto; // Node 18

const bytesOf = async (path) => new Uint8Array(await readFile(path)).buffer;

/** Return what a read of a file's bytes took, and what it gave. */
async function timed(path, read) {
  const bytes = await bytesOf(path);
  const before = process.cpuUsage();
  const heights = await read(bytes);
  const { user, system } = process.cpuUsage(before);
  const digest = createHash("sha256").update(new Uint8Array(heights.buffer)).digest("hex");
  return { seconds: (user + system) / 1e6, digest };
}

const WORK = {
  digests: async (path) => levelDigests(await open(await bytesOf(path))),
  terrainwave: (path, window) =>
    timed(path, async (bytes) => {
      const terrain = await open(bytes);
      const { heights } = await terrain.read(-1, window);
      await terrain.close(); // as Python's "with" does
      return heights;
    }),
  async geotiff(path, window) {
    const { fromArrayBuffer } = await import("geotiff"); // installed by npm in this folder
    const { row, col, nRows, nCols } = window ?? {};
    const options = window ? { window: [col, row, col + nCols, row + nRows] } : {};
    return timed(path, async (bytes) => {
      const tiff = await fromArrayBuffer(bytes);
      const image = await tiff.getImage();
      return (await image.readRasters(options))[0];
    });
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const { what, path, window } = JSON.parse(line);
  console.log(JSON.stringify(await WORK[what](path, window)));
}
