/** Are all levels of the golden files those that their manifest tells? */

import assert from "node:assert/strict";
import { readFile, readdir } from "node:fs/promises";
import { test } from "node:test";

import { UnsupportedError, open } from "../src/index.js";
import { METHODS } from "../src/methods.js";
import { GOLDEN, digests } from "../testing/files.js";

const manifest = JSON.parse(await readFile(new URL("manifest.json", GOLDEN)));

const ofLevel = ({ rows, cols, heights, mask, own }) =>
  own ? { rows, cols, heights, mask, own } : { rows, cols, heights, mask };

for (const [name, { level }] of Object.entries(manifest.files)) {
  test(name, async () => {
    const bytes = await readFile(new URL(name, GOLDEN));
    const method = ["store", "cdf97", "predictive", "cdf53", "rapid"][bytes[34]];
    if (method in METHODS) {
      assert.deepEqual(await digests(await open(bytes)), level.map(ofLevel));
    } else {
      // Features of such methods alone are met first.
      const isNamed = (error) => error instanceof UnsupportedError &&
        (error.message.includes(method) || error.message.startsWith("features"));
      await assert.rejects(open(bytes), isNamed);
    }
  });
}

test("the manifest tells of every file", async () => {
  const files = (await readdir(GOLDEN)).filter((name) => name.endsWith(".twz"));
  assert.deepEqual(files.sort(), Object.keys(manifest.files).sort());
});
