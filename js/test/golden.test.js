/** Are all levels of the golden files those that their manifest tells? */

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { readFile, readdir } from "node:fs/promises";
import { test } from "node:test";

import { UnsupportedError, open } from "../src/index.js";
import { METHODS } from "../src/methods.js";

const GOLDEN = new URL("../../tests/golden/v1/", import.meta.url);
const KINDS = { uint8: "u1", uint16: "u2", int16: "i2", int32: "i4", float32: "f4", float64: "f8" };

/** Return the digests of heights and masks of all levels, as tests/golden_files.py makes them. */
export async function digests(terrain) {
  const [heights, mask] = [createHash("sha256"), createHash("sha256")];
  for (let level = 0; level < terrain.nLevels; level++) {
    const read = await terrain.read(level);
    const shape = `(${read.nRows}, ${read.nCols})`;
    heights.update(KINDS[terrain.dtype] + shape).update(read.heights);
    mask.update(`b1${shape}`).update(read.valid);
  }
  return { heights: heights.digest("hex"), mask: mask.digest("hex") };
}

const manifest = JSON.parse(await readFile(new URL("manifest.json", GOLDEN)));

for (const name of await readdir(GOLDEN)) {
  if (!name.endsWith(".twz")) continue;
  test(name, async () => {
    const bytes = await readFile(new URL(name, GOLDEN));
    const method = ["store", "cdf97", "predictive", "cdf53", "rapid"][bytes[34]];
    if (!(method in METHODS)) {
      await assert.rejects(open(bytes), (error) =>
        error instanceof UnsupportedError && error.message.includes(method));
      return;
    }
    const { heights, mask } = manifest[name];
    assert.deepEqual(await digests(await open(bytes)), { heights, mask });
  });
}
