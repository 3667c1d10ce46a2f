/**
 * Answer lines of standard input, JSON { what, … }, by lines of JSON: of a file at `path` the `digests`
 * of its levels, of one at `url` what `open` and `values` say of it, and the `side` that a read takes.
 */

import { readFile } from "node:fs/promises";
import { createInterface } from "node:readline";

import * as terrainwave from "../src/index.js";
import { digestOf, digests } from "./levels.js";
import { sides } from "./side.js";

const { open } = terrainwave;

const bytesOf = async (path) => new Uint8Array(await readFile(path)).buffer;

let timedSide = null; // geotiff.js, installed by npm in this folder, is loaded when it is first asked for

const WORK = {
  digests: async ({ path }) => digests(await open(await bytesOf(path))),
  async open({ url }) {
    const { nRows, crs, bounds } = await open(url);
    return { nRows, crs, bounds };
  },
  async values({ url, x, y, row, col }) {
    const terrain = await open(url);
    return {
      sample: await terrain.sample(x, y),
      coarse: await terrain.sample(x, y, { level: 1 }),
      blockError: await terrain.blockError(-1, row, col),
      rootError: await terrain.blockError(0, 0, 0),
      transform: terrain.transform(0),
      maxError: terrain.maxError,
    };
  },
  async side({ path, url, ...question }) {
    timedSide ??= sides(terrainwave, await import("geotiff"), digestOf);
    return timedSide({ name: url ?? path, from: url ?? await bytesOf(path), ...question });
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const { what, ...question } = JSON.parse(line);
  console.log(JSON.stringify(await WORK[what](question)));
}

process.exit(); // whatever workers geotiff.js keeps
