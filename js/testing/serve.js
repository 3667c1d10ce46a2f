/**
 * Answer lines of standard input, JSON { what, path }, by lines of JSON: `digests` of a file's
 * levels, or the processor `seconds` of reading all of it.
 */

import { webcrypto } from "node:crypto";
import { readFile } from "node:fs/promises";
import { createInterface } from "node:readline";

import { open } from "../src/index.js";
import { levelDigests } from "./levels.js";

globalThis.crypto ??= webcrypto; // Node 18

const WORK = {
  digests: async (path) => levelDigests(await open(await readFile(path))),
  async seconds(path) {
    const terrain = await open(await readFile(path));
    const before = process.cpuUsage();
    await terrain.read();
    const { user, system } = process.cpuUsage(before);
    return (user + system) / 1e6;
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const { what, path } = JSON.parse(line);
  console.log(JSON.stringify(await WORK[what](path)));
}
