/** Do compiled kernels and plain JavaScript decode the same, of good bytes and of bad ones? */

import assert from "node:assert/strict";
import { test } from "node:test";

import { TerrainwaveError, open } from "../src/index.js";
import { kernels, loadKernels, useKernels } from "../src/kernels.js";
import { Parts, digests, golden } from "../testing/files.js";

await loadKernels();
const loaded = { ...kernels };

async function outcome(bytes) {
  try {
    return await digests(await open(bytes, { maxSamples: 2 ** 20 }));
  } catch (error) {
    if (!(error instanceof TerrainwaveError)) throw error;
    return error.message;
  }
}

async function both(bytes) {
  const compiled = await outcome(bytes);
  useKernels({});
  try {
    return [compiled, await outcome(bytes)];
  } finally {
    useKernels(loaded);
  }
}

test("this engine has the kernels", () => {
  assert.ok(Object.values(loaded).every(Boolean));
});

for (const name of ["rapid-int32-rings", "rapid-int32-wide", "rapid-float32-exact", "predictive-fast-blocks",
  "predictive-int16-halves-bounded", "predictive-float64-exact", "rapid-patched-int16-nodata",
  "rapid-patched-int32-wide", "predictive-patched-int16-rings"]) {
  test(`${name}: the same by both`, async () => {
    const [compiled, plain] = await both(await golden(name));
    assert.ok(compiled[0].heights);
    assert.deepEqual(plain, compiled);
  });
}

for (const name of ["rapid-int32-rings", "rapid-int32-wide", "rapid-int16-states", "predictive-int32-rings",
  "predictive-uint8-best", "rapid-patched-int32-wide", "predictive-patched-float32-nan"]) {
  test(`${name}: the same by both of damaged payloads, checksums mended`, async () => {
    const bytes = await golden(name);
    for (let turn = 0; turn < 12; turn++) {
      const parts = new Parts(bytes);
      const payload = parts.payloads.filter(({ length }) => length > 9).at(-(turn % 2));
      payload[(turn * 7919) % payload.length] ^= 1 << (turn % 8);
      const [compiled, plain] = await both(parts.bytes());
      assert.deepEqual(plain, compiled, `turn ${turn}`);
    }
  });
}
