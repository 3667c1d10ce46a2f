/**
 * Mutate golden files and read them: node testing/fuzz.js SECONDS SEED FINDS STATE
 *
 * Checksums and lengths are mended, so that changes reach what lies behind them. Anything but heights
 * or an error of ours is a find: its file goes to the folder FINDS. STATE is JSON of what was done.
 * Without coverage as a guide, what is accepted or refused in words that no input was before is kept
 * and changed again: so changes add up, and get past one check after the other.
 */

import { readdir, writeFile } from "node:fs/promises";

import { GOLDEN, Parts, golden, random, refusal } from "./files.js";

const [seconds, seed, finds, stateFile] = process.argv.slice(2);
/** Longer files only take longer. */
const MOST_BYTES = 4000;
/** Changed files that are changed again; the last ones. */
const MOST_KEPT = 500;
const NUMBERS = [0, 1, 2, 127, 128, 254, 255];

function canBeTakenApart(bytes) {
  try {
    return bytes.length <= MOST_BYTES && new Parts(bytes).nKeys > 0;
  } catch {
    return false; // several segments
  }
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

const below = random(Number(seed));
const names = (await readdir(GOLDEN)).filter((name) => name.endsWith(".twz")).sort();
const files = (await Promise.all(names.map((name) => golden(name.slice(0, -4))))).filter(canBeTakenApart);
const kept = [];
const refusals = new Set();
const end = performance.now() + 1000 * Number(seconds);
let written = 0;
while (performance.now() < end) {
  const pool = kept.length > 0 && below(2) ? kept : files;
  const bytes = mutant(pool[below(pool.length)], below);
  const started = performance.now();
  try {
    const why = await refusal(bytes, 3);
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
  if (now - written < 1000 && now < end) continue;
  written = now;
  state.memory = Math.max(state.memory, process.memoryUsage.rss());
  await writeFile(stateFile, JSON.stringify(state));
}
