/** Read a file by workers and leave them: node testing/idle.js FILE. Prints how many heights there are. */

import { readFile } from "node:fs/promises";

import { open } from "../src/index.js";

const terrain = await open(await readFile(process.argv[2]), { workers: 2 });
console.log((await terrain.read()).heights.length);
