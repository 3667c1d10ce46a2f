/** Answer the questions of the conformance set (tests/golden/README.md): node testing/conformance.js */

import { readFile } from "node:fs/promises";
import { createInterface } from "node:readline";

import { CorruptStreamError, LimitExceededError, UnsupportedError, open } from "../src/index.js";
import { digestOfLevel } from "./levels.js";

const PROFILE = {
  name: "terrainwave, JavaScript",
  methods: ["store", "cdf97", "predictive", "cdf53", "rapid"],
  features: 31,
  own: true,
  meshes: [],
  blocks: false,
  verifier: false,
};

function describe(terrain) {
  return {
    rows: terrain.nRows,
    cols: terrain.nCols,
    levels: terrain.nLevels,
    dtype: terrain.dtype,
    method: terrain.method,
    max_error: terrain.maxError,
    effective_bound: terrain.effectiveBound,
    metadata: terrain.metadata,
  };
}

async function answer({ task, file, level: number }) {
  if (task === "profile") return PROFILE;
  try {
    const terrain = await open(await readFile(file));
    if (task === "describe") return describe(terrain);
    if (task === "level") return await digestOfLevel(terrain, number);
    if (task !== "check") return { error: "unsupported", message: task };
    for (let k = 0; k < terrain.nLevels; k++) await digestOfLevel(terrain, k);
    return { sound: true };
  } catch (error) {
    const { message } = error;
    if (error instanceof UnsupportedError) return { error: "unsupported", message };
    if (error instanceof CorruptStreamError) return { error: "corrupt", message };
    if (error instanceof LimitExceededError) return { error: "limit", message };
    throw error;
  }
}

for await (const line of createInterface({ input: process.stdin })) {
  console.log(JSON.stringify(await answer(JSON.parse(line))));
}
