/** Windows, places, and where bytes come from. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { crc32 } from "node:zlib";

import {
  ArgumentError, CorruptStreamError, LimitExceededError, SourceError, UnsupportedError, open,
} from "../src/index.js";
import { golden, withLongHead } from "../testing/files.js";

const NAMES = ["rapid-int16-lossless-nodata", "rapid-int32-mask", "store-int16-segments",
  "predictive-float32-rings"];

function cropped({ heights, valid, nCols }, { row, col, nRows, nCols: n }) {
  const rows = Array.from({ length: nRows }, (_, i) => (row + i) * nCols + col);
  const cut = (array) => rows.flatMap((at) => [...array.subarray(at, at + n)]);
  return { heights: cut(heights), valid: cut(valid) };
}

for (const name of NAMES) {
  test(`${name}: windows are parts of the whole, whatever the cache`, async () => {
    const bytes = await golden(name);
    const terrain = await open(bytes);
    const small = await open(bytes, { cacheBytes: 0 });
    for (let level = 0; level < terrain.nLevels; level++) {
      const whole = await terrain.read(level);
      const { nRows, nCols } = terrain.shape(level);
      const [row, col] = [nRows >> 1, nCols >> 2];
      for (const window of [
        { row, col, nRows: nRows - row, nCols: nCols - col }, { row, col, nRows: 1, nCols: 1 },
        { row: 0, col: 0, nRows: row + 1, nCols },
      ]) {
        for (const from of [small, terrain]) {
          const { heights, valid } = await from.read(level, window);
          assert.deepEqual({ heights: [...heights], valid: [...valid] }, cropped(whole, window));
        }
      }
    }
  });
}

test("bytes, Blobs and the caller's own source give the same", async () => {
  const bytes = await golden("rapid-int16-halves");
  const { heights } = await (await open(bytes)).read();
  const own = { size: bytes.length, read: async (start, end) => bytes.subarray(start, end) };
  const buffer = Uint8Array.from(bytes).buffer;
  for (const from of [buffer, new DataView(buffer), new Blob([bytes]), own]) {
    assert.deepEqual((await (await open(from)).read()).heights, heights);
  }
  const short = { ...own, read: async (start, end) => bytes.subarray(start, end - 1) };
  await assert.rejects(open(short), SourceError);
  const broken = { ...own, read: async () => { throw new Error("gone"); } };
  await assert.rejects(open(broken), (error) => error instanceof SourceError && /gone/.test(error));
  await assert.rejects(open(17), ArgumentError);
});

/** Return a fetch of one file, and the ranges it was asked for. */
function server(bytes, { knowsRanges = true, tag = () => '"1"' } = {}) {
  const asked = [];
  const fetch = async (url, { headers }) => {
    const [, first, last] = /^bytes=(\d+)-(\d+)$/.exec(headers.Range);
    asked.push([Number(first), Number(last)]);
    const etag = tag(asked.length);
    if (!knowsRanges) return new Response(bytes, { headers: { etag } });
    const part = bytes.subarray(Number(first), Number(last) + 1);
    const range = `bytes ${first}-${Number(first) + part.length - 1}/${bytes.length}`;
    return new Response(part, { status: 206, headers: { etag, "content-range": range } });
  };
  return { fetch, asked };
}

test("a URL is read by ranges, opened by one", async () => {
  const bytes = await golden("rapid-int16-states");
  const { fetch, asked } = server(bytes);
  const terrain = await open("https://example.org/a.twz", { fetch });
  assert.equal(asked.length, 1);
  const { heights } = await terrain.read();
  assert.deepEqual(heights, (await (await open(bytes)).read()).heights);
});

test("a head of any length takes two requests: pages have at most 32 KiB, however large the raster", async () => {
  const bytes = await withLongHead("rapid-int16-states");
  const { fetch, asked } = server(bytes);
  assert.equal((await open("https://example.org/a.twz", { fetch })).nRows, (await open(bytes)).nRows);
  assert.deepEqual(asked.map(([first]) => first), [0, 16384]);
});

test("a server without ranges serves all at once", async () => {
  const { fetch, asked } = server(await golden("rapid-int16-states"), { knowsRanges: false });
  const terrain = await open(new URL("https://example.org/a.twz"), { fetch });
  await terrain.read();
  assert.equal(asked.length, 1);
});

test("a file that changes, errors of HTTP and wrong ranges are refused", async () => {
  const bytes = await withLongHead("rapid-int16-states");
  const { fetch } = server(bytes, { tag: (n) => (n < 3 ? '"1"' : '"2"') });
  const terrain = await open("https://example.org/a.twz", { fetch });
  await assert.rejects(terrain.read(), /changed/);
  for (const response of [
    () => new Response("no", { status: 404 }), () => new Response(bytes, { status: 206 }),
    () => new Response(bytes, { status: 206, headers: { "content-range": "bytes 5-9/4854" } }),
    () => Promise.reject(new Error("offline")),
  ]) {
    await assert.rejects(open("https://example.org/", { fetch: async () => response() }), SourceError);
  }
});

test("arguments that make no sense are refused", async () => {
  const terrain = await open(await golden("rapid-uint8"), { maxSamples: 100 });
  const one = { row: 0, col: 0, nRows: 1, nCols: 1 };
  for (const change of [{ row: -1 }, { nRows: 0 }, { nCols: -3 }, { col: 1e9 }, { col: 0.5 }, { row: NaN }]) {
    await assert.rejects(terrain.read(0, { ...one, ...change }), ArgumentError);
  }
  await assert.rejects(terrain.read(terrain.nLevels), ArgumentError);
  await assert.rejects(terrain.read(-1 - terrain.nLevels), ArgumentError);
  await assert.rejects(terrain.read(), LimitExceededError);
  await assert.rejects(terrain.blockError(0, 0, 1), ArgumentError);
});

test("windows past the edge are cut, as by Python", async () => {
  const terrain = await open(await golden("rapid-int16-halves"));
  const { nRows, nCols } = terrain.shape();
  for (const [window, part] of [
    [{ row: -3, col: -2, nRows: 8, nCols: 9 }, { row: 0, col: 0, nRows: 5, nCols: 7 }],
    [{ row: nRows - 4, col: 5, nRows: 1e9, nCols: 2 }, { row: nRows - 4, col: 5, nRows: 4, nCols: 2 }],
    [{ row: -1, col: nCols - 1 }, { row: 0, col: nCols - 1, nRows, nCols: 1 }],
    [{ col: -1, nCols: nCols + 2 }, { row: 0, col: 0, nRows, nCols }],
  ]) {
    assert.deepEqual(await terrain.read(-1, window), await terrain.read(-1, part));
    const { heights, valid, level, ...place } = await terrain.read(-1, window);
    assert.deepEqual(place, part);
  }
});

test("windows that are read in parts are those that are read at once", async () => {
  const bytes = await golden("store-int16-segments");
  const [terrain, other] = [await open(bytes), await open(bytes, { workers: 3, cacheBytes: 0 })];
  const { nRows, nCols } = terrain.shape();
  const whole = await terrain.read();
  assert.deepEqual(await other.read(), whole); // in parts of two units
  for (let row = 0; row < nRows; row += 37) {
    const window = { row, col: (row * 5) % nCols, nRows: 300, nCols: 200 };
    assert.deepEqual(await other.read(-1, window), await terrain.read(-1, window));
  }
  await other.close();
});

test("a closed terrain is refused, and its memory serves the next one", async () => {
  for (let time = 0; time < 3; time++) {
    for (const name of ["rapid-int16-halves", "cdf97-float32-nan-zerotree", "cdf53-int16-lossless"]) {
      const terrain = await open(await golden(name));
      const { heights } = await terrain.read();
      const reading = terrain.read();
      await terrain.close();
      await reading.catch((error) => assert.ok(error instanceof ArgumentError));
      await assert.rejects(terrain.read(), ArgumentError);
      await assert.rejects(terrain.blockError(0, 0, 0), ArgumentError);
      const again = await open(await golden(name));
      assert.deepEqual((await again.read()).heights, heights);
      await again.close();
    }
  }
});

test("a newer version and features are unsupported, other bytes are corrupt", async () => {
  const bytes = Uint8Array.from(await golden("rapid-uint8"));
  bytes[8] = 1; // alone, damage
  await assert.rejects(open(bytes), CorruptStreamError);
  new DataView(bytes.buffer).setUint32(124, crc32(bytes.subarray(0, 124)), true);
  await assert.rejects(open(bytes), (error) => error instanceof UnsupportedError &&
    error.message.includes("found format version 1, expected 2: made by a development build: compress the raster again"));
  bytes[0] = 0;
  await assert.rejects(open(bytes), CorruptStreamError);
});

test("a tile is digested only if its sides and arrays fit, and what is read later is right", async () => {
  const terrain = await open(await golden("rapid-int16-halves"), { workers: 0 });
  const { heights } = await terrain.read();
  const tile = (nRows, nCols, n = nRows * nCols) => ({ nRows, nCols, heights: new Int16Array(n), valid: new Uint8Array(n) });
  assert.equal((await terrain.digest(tile(512, 512))).length, 32);
  const wrong = [tile(513, 1), tile(1, 600000), tile(0, 4), tile(1.5, 2), tile(-1, -1), tile(4, 4, 15), tile(4, 4, 17),
    { ...tile(4, 4), heights: new Float64Array(16) }, { ...tile(4, 4), valid: new Uint8Array(3) }, { nRows: 4, nCols: 4 }];
  for (const one of wrong) await assert.rejects(terrain.digest(one), (error) => error instanceof ArgumentError && /expected/.test(error.message));
  await assert.rejects(terrain.rootOf([1, 2]), ArgumentError);
  assert.deepEqual((await terrain.read()).heights, heights);
});

test("samples at centres are the heights, halfway their mean, NaN outside", async () => {
  const terrain = await open(await golden("rapid-int16-halves"));
  const [a, b, c, d, e, f] = terrain.transform();
  const { heights, nCols } = await terrain.read();
  const at = (row, col) => [a * (col + 0.5) + b * (row + 0.5) + c, d * (col + 0.5) + e * (row + 0.5) + f];
  const scaled = (raw) => raw * terrain.scale + terrain.offset;
  assert.equal(await terrain.sample(...at(3, 5)), scaled(heights[3 * nCols + 5]));
  const mean = (heights[3 * nCols + 5] + heights[4 * nCols + 5]) / 2;
  assert.ok(Math.abs((await terrain.sample(...at(3.5, 5))) - scaled(mean)) < 1e-9);
  assert.ok(Number.isNaN(await terrain.sample(...at(-0.25, 5))));
  const { left, right, bottom, top } = terrain.bounds;
  assert.ok(left < right && bottom < top);
});

test("levels are void where the full grid is", async () => {
  const terrain = await open(await golden("rapid-int16-lossless-nodata"));
  assert.equal(terrain.hasVoids, true);
  const full = await terrain.read();
  for (let level = 0; level < terrain.nLevels - 1; level++) {
    const step = 2 ** (terrain.nLevels - 1 - level);
    const { heights, valid, nRows, nCols } = await terrain.read(level);
    const any = await terrain.read(level, {}, { voids: "any" });
    assert.ok(any.valid.some((bit, i) => bit > valid[i]));
    for (let row = 0; row < nRows; row++) {
      for (let col = 0; col < nCols; col++) {
        const i = row * nCols + col;
        assert.equal(valid[i], full.valid[row * step * full.nCols + col * step]);
        assert.equal(heights[i], valid[i] ? any.heights[i] : terrain.nodata);
      }
    }
    const at = any.valid.findIndex((bit, i) => bit > valid[i]);
    const [a, , c, , e, f] = terrain.transform(level);
    const place = [c + a * ((at % nCols) + 0.5), f + e * (Math.floor(at / nCols) + 0.5)];
    assert.ok(Number.isNaN(await terrain.sample(...place, { level })));
    assert.ok(!Number.isNaN(await terrain.sample(...place, { level, voids: "any" })));
  }
});

test("a file says whether any sample is void, whatever value it declares", async () => {
  const terrain = await open(await golden("rapid-int16-declared"));
  assert.equal(terrain.hasVoids, false);
  assert.equal(terrain.nodata, -9999);
  assert.ok(!(await terrain.read(0)).valid.includes(0));
  await assert.rejects(terrain.read(0, {}, { voids: "all" }), ArgumentError);
});
