/**
 * Answer lines of standard input, JSON { what, path, window }, by lines of JSON: `digests` of a
 * file's levels, or what `terrainwave` or `geotiff` took to open a file in memory and to read a
 * window of it, or all: processor seconds of all threads, and the SHA-256 of the heights. `side`, with
 * { who, path or url, window, workers }: seconds of a clock (side.js).
 */

import { createHash, webcrypto } from "node:crypto";
import { readFile } from "node:fs/promises";
import { createInterface } from "node:readline";

import * as terrainwave from "../src/index.js";
import { levelDigests } from "./levels.js";
import { sides } from "./side.js";

const { open } = terrainwave;

globalThis.crypto ??= webcrypto; // Node 18

const bytesOf = async (path) => new Uint8Array(await readFile(path)).buffer;

const digestOf = (array) => createHash("sha256").update(new Uint8Array(array.buffer)).digest("hex");

let timedSide = null; // geotiff.js is loaded when it is first asked for

/** Return what a read of a file's bytes took, and what it gave. */
async function timed(path, read) {
  const bytes = await bytesOf(path);
  const before = process.cpuUsage();
  const heights = await read(bytes);
  const { user, system } = process.cpuUsage(before);
  return { seconds: (user + system) / 1e6, digest: digestOf(heights) };
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
  async side(path, window, { who, url, workers }) {
    timedSide ??= sides(terrainwave, await import("geotiff"), digestOf);
    return timedSide({ who, name: url ?? path, from: url ?? await bytesOf(path), window, workers });
  },
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
  const { what, path, window, ...more } = JSON.parse(line);
  console.log(JSON.stringify(await WORK[what](path, window, more)));
}

process.exit(); // whatever workers geotiff.js keeps
