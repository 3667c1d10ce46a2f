/** Damaged and hostile bytes give an error of ours, or heights: never a hang, never NaN. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { deflateRawSync } from "node:zlib";

import { CorruptStreamError, open } from "../src/index.js";
import { Parts, golden, random, refusal } from "../testing/files.js";

const ANNEXES = new URL("../../src/terrainwave/annexes/", import.meta.url);
const DICTIONARY = readFileSync(new URL("dictionary.txt", ANNEXES)); // FORMAT.md §4.6

const isRefused = async (bytes) => (await refusal(bytes)) !== "";

function flip(bytes, i, bit) {
  const flipped = Uint8Array.from(bytes);
  flipped[i] ^= 1 << bit;
  return flipped;
}

for (const name of ["store-int16-nodata-halves", "rapid-uint8", "rapid-float32-exact"]) {
  test(`${name}: every prefix, and one byte more`, async () => {
    const bytes = await golden(name);
    const step = bytes.length > 2000 ? 13 : 1;
    for (let n = 0; n < bytes.length; n += step) assert.ok(await isRefused(bytes.subarray(0, n)), n);
    assert.ok(await isRefused(Buffer.concat([bytes, Buffer.from([0])])));
    assert.ok(!(await isRefused(bytes)));
  });

  test(`${name}: every flipped bit is noticed`, async () => {
    const bytes = await golden(name);
    for (let i = 0; i < bytes.length; i += bytes.length > 2000 ? 11 : 1) {
      assert.ok(await isRefused(flip(bytes, i, i % 8)), `byte ${i}`);
    }
  });
}

for (const name of ["store-float64-rqt", "rapid-uint8", "rapid-int16-states", "rapid-int32-wide",
  "rapid-float32-nan", "rapid-float32-exact", "rapid-int32-mask",
  "predictive-int32-rings", "predictive-uint8-best", "predictive-int16-lossless",
  "rapid-patched-int16-nodata", "predictive-patched-int16-rings", "cdf97-float32-nan-zerotree",
  "cdf97-int32-rings-faithful", "cdf53-int16-lossless", "cdf53-uint16-rate"]) {
  test(`${name}: changed, with all checksums mended`, async () => {
    const bytes = await golden(name);
    assert.ok(!(await isRefused(new Parts(bytes).bytes())), "the parts make a good file");
    const below = random(1);
    let nRefused = 0;
    for (let turn = 0; turn < 120; turn++) {
      const parts = new Parts(bytes);
      const sections = [parts.header, parts.metadata, parts.parameters, parts.columns];
      sections.push(...parts.payloads, ...parts.payloads, ...parts.payloads);
      const filled = sections.filter((section) => section.length > 0);
      const section = filled[below(filled.length)];
      for (let k = below(3); k >= 0; k--) section[below(section.length)] = below(256);
      nRefused += await isRefused(parts.bytes());
    }
    assert.ok(nRefused > 12, `${nRefused} of 120 refused`);
  });

  test(`${name}: payloads cut off, lengthened, exchanged`, async () => {
    const bytes = await golden(name);
    const n = new Parts(bytes).nKeys;
    for (let i = 0; i < Math.min(n, 12); i++) {
      for (const change of [(p) => p.slice(0, p.length >> 1), (p) => p.slice(0, -1),
        (p) => Uint8Array.from([...p, 0])]) {
        const parts = new Parts(bytes);
        if (parts.payloads[i].length === 0) continue;
        parts.payloads[i] = change(parts.payloads[i]);
        assert.ok(await isRefused(parts.bytes()), `payload ${i}`);
      }
      const parts = new Parts(bytes);
      parts.payloads[i] = parts.payloads[(i + 1) % n];
      await isRefused(parts.bytes());
    }
  });
}

test("columns that inflate to more than their size are not inflated", async () => {
  const parts = new Parts(await golden("rapid-uint8"));
  parts.columns = Buffer.concat([parts.columns, Buffer.alloc(2 ** 23)]);
  const { bytes } = parts;
  parts.setColumn = () => {};
  await assert.rejects(open(bytes.call(parts)), /inflates to more than/);
});

test("metadata are strict JSON", async () => {
  const withText = async (text) => {
    const parts = new Parts(await golden("rapid-uint8"));
    parts.metadata = deflateRawSync(Buffer.from(text), { dictionary: DICTIONARY });
    return open(parts.bytes());
  };
  const nested = (depth) => `{"x":${"[".repeat(depth - 1)}${"]".repeat(depth - 1)}}`;
  for (const good of ["{}", ' {"x" : [1, true, null, -0.5e-3, "\\ud83d\\ude00"]} ', nested(16),
    '{"nodata":255}', '{"scale":null}', '{"transform":[1,0,0,0,-1,18446744073709551616]}']) {
    assert.ok(await withText(good), good);
  }
  for (const bad of ["", "[]", "{", "{} x", '{"a":1,"a":1}', '{"a":NaN}', '{"a":1e999}', '{"a":01}',
    '{"a":"\\ud83d"}', '{"a":"\n"}', '\ufeff{}', nested(17), "[".repeat(100000), '{"nodata":256}',
    '{"nodata":"nan"}', '{"scale":0}', '{"transform":[1,0,0,0,-1]}', '{"tags":{"a":1}}',
    '{"transform":[1,0,0,0,-1,18446744073709551617]}', '{"crs":4326}', '{"a":1,}']) {
    await assert.rejects(withText(bad), CorruptStreamError, bad);
  }
});
