/**
 * Print what files decode to, as JSON: node testing/dump.js digests FILE… | open URL | values URL X Y ROW COL
 */

import { open } from "../src/index.js";
import { digests } from "./files.js";
import { readFile } from "node:fs/promises";

const [what, ...rest] = process.argv.slice(2);

async function found() {
  if (what === "digests") {
    const all = {};
    for (const path of rest) all[path] = await digests(await open(await readFile(path)));
    return all;
  }
  const terrain = await open(rest[0]);
  if (what === "open") return { nRows: terrain.nRows, crs: terrain.crs, bounds: terrain.bounds };
  const [x, y, row, col] = rest.slice(1).map(Number);
  return {
    sample: await terrain.sample(x, y),
    coarse: await terrain.sample(x, y, { level: 1 }),
    blockError: await terrain.blockError(-1, row, col),
    rootError: await terrain.blockError(0, 0, 0),
    transform: terrain.transform(0),
    maxError: terrain.maxError,
  };
}

console.log(JSON.stringify(await found()));
