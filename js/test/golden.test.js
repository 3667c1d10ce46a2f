/** Are all levels of the golden files those that their manifest tells? */

import assert from "node:assert/strict";
import { readFile, readdir } from "node:fs/promises";
import { test } from "node:test";

import { open } from "../src/index.js";
import { GOLDEN } from "../testing/files.js";
import { digests } from "../testing/levels.js";

const manifest = JSON.parse(await readFile(new URL("manifest.json", GOLDEN)));

const ofLevel = ({ rows, cols, heights, mask, own }) =>
  own ? { rows, cols, heights, mask, own } : { rows, cols, heights, mask };

for (const [name, { level }] of Object.entries(manifest.files)) {
  test(name, async () => {
    const bytes = await readFile(new URL(name, GOLDEN));
    assert.deepEqual(await digests(await open(bytes)), level.map(ofLevel));
  });
}

test("the manifest tells of every file", async () => {
  const files = (await readdir(GOLDEN)).filter((name) => name.endsWith(".twz"));
  assert.deepEqual(files.sort(), Object.keys(manifest.files).sort());
});
