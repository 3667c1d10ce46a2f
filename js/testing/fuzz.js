/**
 * Mutate golden files and read them: node testing/fuzz.js SECONDS SEED FINDS STATE
 *
 * Checksums and lengths are mended, so that changes reach what lies behind them. Anything but heights
 * or an error of ours is a find: its file goes to the folder FINDS. STATE is JSON of what was done.
 * Without coverage as a guide, what is accepted or refused in words that no input was before is kept
 * and changed again: so changes add up, and get past one check after the other.
 */

import { readdir, writeFile } from "node:fs/promises";

import { TerrainwaveError, open } from "../src/index.js";
import { GOLDEN, Parts, golden } from "./files.js";

const [seconds, seed, finds, stateFile] = process.argv.slice(2);
const MOST_SAMPLES = 2 ** 20;
/** Longer files only take longer. */
const MOST_BYTES = 4000;
/** Changed files that are changed again; the last ones. */
const MOST_KEPT = 500;
const NUMBERS = [0, 1, 2, 127, 128, 254, 255];

/** A small generator of numbers below n. */
function random(start) {
  let state = Number(start) >>> 0;
  return (n) => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    return Math.floor((state / 2 ** 32) * n);
  };
}

async function partsOfFiles() {
  const found = [];
  for (const name of (await readdir(GOLDEN)).filter((file) => file.endsWith(".twz")).sort()) {
    const bytes = await golden(name.slice(0, -4));
    if (bytes.length > MOST_BYTES) continue;
    try {
      await open(bytes);
      new Parts(bytes);
      found.push(bytes);
    } catch {
      // Several segments.
    }
  }
  return found;
}

function changed(section, below) {
  const bytes = Array.from(section);
  for (let k = below(4); k >= 0; k--) {
    const at = below(bytes.length + 1);
    const kind = below(5);
    if (kind === 0) bytes.splice(at, 1 + below(4));
    else if (kind === 1) bytes.splice(at, 0, ...Array.from({ length: 1 + below(4) }, () => below(256)));
    else if (at < bytes.length) {
      if (kind === 2) bytes[at] ^= 1 << below(8);
      else bytes[at] = kind === 3 ? below(256) : NUMBERS[below(NUMBERS.length)];
    }
  }
  return Uint8Array.from(bytes);
}

/** Return a file with one to three sections changed. */
function mutant(bytes, below) {
  const parts = new Parts(bytes);
  for (let k = below(3); k >= 0; k--) {
    const kind = below(10);
    if (kind === 0) parts.header[below(124)] = NUMBERS[below(NUMBERS.length)];
    else if (kind === 1) parts.metadata = changed(parts.metadata, below);
    else if (kind === 2) parts.parameters = changed(parts.parameters, below);
    else if (kind === 3) parts.columns[below(parts.columns.length)] = below(256);
    else {
      const i = below(parts.nKeys);
      parts.payloads[i] = changed(parts.payloads[i], below);
    }
  }
  return parts.bytes();
}

/** Read a corner of each level; return why it is refused, or "" where all of it is accepted. */
async function refusal(bytes) {
  let terrain;
  try {
    terrain = await open(bytes, { maxSamples: MOST_SAMPLES });
    for (let level = Math.max(0, terrain.nLevels - 3); level < terrain.nLevels; level++) {
      const { nRows, nCols, heights, valid } = await terrain.read(level);
      if (heights.length !== nRows * nCols || valid.length !== heights.length) {
        throw new Error(`${heights.length} heights, ${valid.length} valid, ${nRows} x ${nCols}`);
      }
      for (let i = 0; i < valid.length; i++) {
        if (valid[i] && !Number.isFinite(heights[i])) throw new Error("a height is not finite");
      }
    }
    return "";
  } catch (error) {
    if (!(error instanceof TerrainwaveError) || error.message.includes("broke off")) throw error;
    return error.message.replace(/[\d.-]+/g, "0");
  } finally {
    await terrain?.close(); // another file gets the memory as this one leaves it
  }
}

function canBeTakenApart(bytes) {
  try {
    return new Parts(bytes).nKeys > 0 && bytes.length <= MOST_BYTES;
  } catch {
    return false;
  }
}

const state = { executions: 0, accepted: 0, seconds: Number(seconds), finds: 0, slowest: 0, memory: 0 };
const places = new Set();

async function keep(bytes, error) {
  const place = String(error.stack).split("\n").slice(0, 2).join(" ");
  if (places.has(place)) return;
  places.add(place);
  state.finds++;
  await writeFile(`${finds}/find-javascript-${state.executions}.twz`, bytes);
  await writeFile(`${finds}/find-javascript-${state.executions}.txt`, String(error.stack));
}

const below = random(seed);
const files = await partsOfFiles();
const kept = [];
const refusals = new Set();
const end = performance.now() + 1000 * Number(seconds);
let written = 0;
while (performance.now() < end) {
  const pool = kept.length > 0 && below(2) ? kept : files;
  const bytes = mutant(pool[below(pool.length)], below);
  const started = performance.now();
  try {
    const why = await refusal(bytes);
    if (why === "") state.accepted++;
    // A header that is refused cannot be taken apart again, nor can a page.
    if ((why === "" || !refusals.has(why)) && canBeTakenApart(bytes)) {
      kept[kept.length < MOST_KEPT ? kept.length : below(MOST_KEPT)] = bytes;
    }
    refusals.add(why);
  } catch (error) {
    await keep(bytes, error);
  }
  const now = performance.now();
  state.executions++;
  state.slowest = Math.max(state.slowest, (now - started) / 1000);
  if (now - written > 1000) {
    written = now;
    state.memory = Math.max(state.memory, process.memoryUsage.rss());
    await writeFile(stateFile, JSON.stringify(state));
  }
}
state.memory = Math.max(state.memory, process.memoryUsage.rss());
await writeFile(stateFile, JSON.stringify(state));
