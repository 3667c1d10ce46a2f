/** Blocks that many readers share, places by polynomials, grids of heights. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { addTerrains, demSource } from "../map/maplibre.js";
import { gridMesh } from "../map/mesh.js";
import { Places } from "../map/places.js";
import { growInto, largestDistance, shareOfVoids, without } from "../map/surfaces.js";
import { BLOCK, BlockSource } from "../src/blocks.js";
import { Core } from "../src/core.js";
import { ArgumentError, LimitExceededError, open } from "../src/index.js";
import { loadModule } from "../src/module.js";
import { Ranges } from "../src/source.js";
import { golden } from "../testing/files.js";

class Counted {
  constructor(size) {
    this.bytes = Uint8Array.from({ length: size }, (_, i) => (i * 7919) >> 3);
    this.size = size;
    this.asked = [];
    this.isBroken = false;
  }

  async head(n) {
    return this.read(0, Math.min(n, this.size));
  }

  async read(start, end) {
    this.asked.push([start, end]);
    if (this.isBroken) throw new Error("no answer");
    return this.bytes.subarray(start, end);
  }
}

test("what many readers want at once comes by few requests, and once", async () => {
  const source = new Counted(12 * BLOCK + 5);
  const blocks = new BlockSource(source);
  assert.deepEqual(await blocks.head(100), source.bytes.subarray(0, 100));
  const spans = [
    [3, 50], [BLOCK - 1, 2 * BLOCK + 1], [2 * BLOCK + 7, 3 * BLOCK], [7 * BLOCK, 7 * BLOCK + 2],
    [9 * BLOCK, 12 * BLOCK + 5], [12 * BLOCK + 1, 12 * BLOCK + 3],
  ];
  for (let time = 0; time < 2; time++) {
    const found = await Promise.all(spans.map(([start, end]) => blocks.read(start, end)));
    found.forEach((bytes, i) => assert.deepEqual(bytes, source.bytes.subarray(...spans[i])));
  }
  const { size } = source;
  assert.deepEqual(source.asked, [[0, BLOCK], [BLOCK, 3 * BLOCK], [7 * BLOCK, size]]);
});

test("ranges come by three requests where gaps are worth it", async () => {
  const source = new Counted(1 << 22);
  const ranges = [0, 1, 2, 7, 8, 9, 20, 30].map((place) => ({ start: place << 16, end: (place << 16) + 20000 }));
  const found = await new Ranges(source).read(ranges);
  found.forEach((bytes, i) => assert.deepEqual(bytes, source.bytes.subarray(ranges[i].start, ranges[i].end)));
  assert.deepEqual(source.asked.map(([start]) => start >> 16), [0, 20, 30]);
  source.asked.length = 0;
  await new Ranges(source).read(ranges.slice(2, 4)); // few requests: a gap of 308 kB is not worth it
  assert.equal(source.asked.length, 2);
});

test("pages of the index are fetched once", async () => {
  const source = new Counted(1 << 20);
  const ranges = new Ranges(source);
  const [page, payload] = [{ start: 100, end: 200, isPage: true }, { start: 900_000, end: 900_100 }];
  await ranges.read([page, payload]);
  await ranges.read([page, payload]);
  assert.deepEqual(source.asked, [[100, 200], [900_000, 900_100], [900_000, 900_100]]);
});

test("a block that did not come is asked for again", async () => {
  const source = new Counted(3 * BLOCK);
  const blocks = new BlockSource(source);
  await blocks.head(10);
  source.isBroken = true;
  const both = await Promise.allSettled([blocks.read(BLOCK, BLOCK + 9), blocks.read(BLOCK + 9, 2 * BLOCK)]);
  assert.ok(both.every(({ status, reason }) => status === "rejected" && /no answer/.test(reason)));
  source.isBroken = false;
  assert.deepEqual(await blocks.read(BLOCK, BLOCK + 9), source.bytes.subarray(BLOCK, BLOCK + 9));
});

test("heights by blocks are those of the file", async () => {
  const bytes = await golden("rapid-int16-lossless-nodata");
  const fetchRange = async (_, { headers: { Range } }) => {
    const [start, end] = Range.match(/\d+/g).map(Number);
    const part = bytes.subarray(start, end + 1);
    const range = `bytes ${start}-${start + part.length - 1}/${bytes.length}`;
    return new Response(part, { status: 206, headers: { "content-range": range } });
  };
  const options = { fetch: fetchRange, blocks: true };
  const [whole, terrain] = [await open(bytes), await open("http://host/a.twz", options)];
  const read = await Promise.all([0, -1].map((level) => terrain.read(level)));
  assert.deepEqual(read, await Promise.all([0, -1].map((level) => whole.read(level))));
});

test("units that two reads want at once are decoded once", async () => {
  const bytes = await golden("store-int16-segments");
  const core = await Core.start(await loadModule(), bytes.length, 2 ** 24);
  const held = [{ start: 0, bytes }];
  assert.deepEqual(core.open(held), []);
  const place = { level: core.describe().nLevels - 1, row: 0, col: 0, nRows: 1100, nCols: 2, isExact: false };
  const [once, nothing] = [[], []];
  core.read(place, held, (heights) => once.push(...heights));
  // All is there already: another read needs not a byte.
  assert.deepEqual(core.read(place, [], (heights) => nothing.push(...heights)), {});
  assert.deepEqual(nothing, once);
});

test("of a server without ranges no more than 64 MiB are read", async () => {
  const part = new Uint8Array(2 ** 22);
  const endless = (headers) => async () => {
    const body = new ReadableStream({ pull: (controller) => controller.enqueue(part) });
    return new Response(body, { status: 200, headers });
  };
  for (const headers of [{ "content-length": String(2 ** 26 + 1) }, {}]) {
    const opened = open("http://host/a.twz", { fetch: endless(headers) });
    await assert.rejects(opened, (error) => error instanceof LimitExceededError);
  }
});

const HALF_DEGREES = {
  domain: [10, 40, 20, 45], rows: [[4.5], [-5]], cols: [[9.5, 10]], turn: 720, goes_round: false,
};

test("places of degrees are those of the raster's pixels, of any turn", () => {
  const places = new Places(HALF_DEGREES, { nRows: 10, nCols: 20 });
  const { rows, cols } = places.toSamples([10, 10.25, 19.75 - 360, 370.25, 9.9], [45, 44.75, 39]);
  assert.deepEqual([...cols.subarray(5, 10)], [0, 0, 19, 0, NaN]);
  assert.deepEqual([...rows.subarray(0, 4)], [0, 0, 0, 0]);
  assert.ok(Math.abs(rows[5]) < 1e-9);
  assert.ok(rows.subarray(10).every(Number.isNaN));
});

for (const [name, wrong] of Object.entries({
  "no table": { rows: 3 }, "a ragged one": { cols: [[1, 2], [3]] }, "no number": { rows: [["1"]] },
  "a long one": { cols: [new Array(999).fill(0)] }, "a domain turned over": { domain: [20, 40, 10, 45] },
})) {
  test(`places with ${name} are refused`, () => {
    const make = () => new Places({ ...HALF_DEGREES, ...wrong }, { nRows: 10, nCols: 20 });
    assert.throws(make, ArgumentError);
  });
}

test("heights go on into voids as means, and voids are shares of pixels", () => {
  const heights = Float64Array.of(1, NaN, NaN, 3, NaN, NaN, NaN, NaN, NaN);
  assert.deepEqual([...growInto(heights, 3, 1)], [1, 2, NaN, 3, 2, NaN, 3, 3, NaN]);
  assert.deepEqual([...without(growInto(heights, 3, 2), 3, 1)], [2]);
  assert.deepEqual([...shareOfVoids(heights, 3, 0)], [64, 255, 207, 255]);
  const coarse = Float64Array.of(0, 2, 2, 4);
  assert.equal(largestDistance(coarse, Float64Array.of(0, 1, 2, 1, 5, 3, 2, NaN, 4), 3), 3);
});

/** A globe whose heights are 1000 m and 10 m more with each degree east and 20 m with each north, void in the west. */
function slantingGlobe(firstLongitude = -Infinity) {
  const toSamples = (lon, lat) => ({ lon, lat });
  const heightOf = (lon, lat) => (lon < firstLongitude ? NaN : 1000 + 10 * lon + 20 * lat);
  return {
    axis: 6378137, extent: [-180, -90, 180, 90], lowest: 0, places: { toSamples }, levelFor: () => 3,
    heightsAt: async ({ lon, lat }) => ({
      heights: Float64Array.from(lat.flatMap((y) => lon.map((x) => heightOf(x, y)))), window: {},
    }),
    heightsError: async () => 5,
  };
}

test("a mesh covers its tile once, at the heights, and skirts hang from its edges", async () => {
  const n = 5;
  const { positions, normals, indices, lowest, highest } = await gridMesh(slantingGlobe(), 2, 2, 1, n);
  const at = (i) => [...positions.subarray(3 * i, 3 * i + 3)];
  let [area, nSkirts] = [0, 0];
  for (let k = 0; k < indices.length; k += 3) {
    const [a, b, c] = [...indices.subarray(k, k + 3)].map(at);
    const twice = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
    assert.ok(twice >= 0); // counterclockwise, seen from above
    area += twice / 2;
    if (twice === 0) nSkirts++;
  }
  // Tile 2/2/1 is the quarter turn east of Greenwich and north of the equator: 128 of 512 units wide.
  assert.equal(area, 128 ** 2);
  assert.equal(nSkirts, 4 * 2 * (n - 1));
  assert.deepEqual(at(n * (n - 1)), [256, 256, 1000]); // 0 degrees, 0 degrees
  assert.equal(at(n * n - 1)[2], 1900); // 90 degrees east
  assert.ok(Math.abs(highest - (1900 + 20 * 66.513)) < 0.1);
  const bottoms = positions.filter((_, i) => i % 3 === 2 && i >= 3 * n * n);
  assert.ok(Math.min(...bottoms) <= 1000 - 2 * 5);
  assert.equal(lowest, 1000);
  const [east, north, up] = normals.subarray(3 * n * (n - 1));
  assert.ok(east < 0 && north < 0 && up > 0); // it rises to the north-east, also at its corner
});

test("cells with a void corner are in no mesh, and a tile without heights has no triangle", async () => {
  const some = await gridMesh(slantingGlobe(29.9), 2, 2, 1, 4);
  const used = [...some.indices].map((i) => some.positions[3 * i]);
  assert.ok(Math.min(...used) > 256 + 128 / 3 - 1e-3 && some.indices.length > 0);
  assert.ok(some.positions.every(Number.isFinite));
  const none = await gridMesh(slantingGlobe(200), 2, 2, 1, 4);
  assert.equal(none.indices.length, 0);
  assert.deepEqual([none.lowest, none.highest], [0, 0]);
});

test("terrains of all calls of addTerrains are kept, by URL", async () => {
  const protocols = {};
  const maplibre = { addProtocol: (scheme, load) => { protocols[scheme] = load; } };
  const maker = (name) => ({ ask: async ({ url }) => ({ image: `${name}: ${url}` }) });
  const terrain = (name, url) => ({ name, url, described: { bounds: [0, 0, 1, 1], maxzoom: 9 } });
  const load = async (url) => (await protocols.twz({ url }, {})).data;
  const tileOf = (of) => load(demSource(of).tiles[0].replace("{z}/{x}/{y}", "5/3/4"));
  const [alps, andes] = [terrain("alps", "a/alps.twz"), terrain("andes", new URL("http://host/a b/andes.twz?c={d}"))];
  const [one, other] = [terrain("dem", "1/dem.twz"), terrain("dem", "2/dem.twz")];
  addTerrains(maplibre, [alps, one], maker("first"));
  addTerrains(maplibre, [andes, other], maker("second"));
  assert.equal(await tileOf(alps), "first: a/alps.twz");
  assert.equal(await tileOf(andes), "second: http://host/a%20b/andes.twz?c={d}");
  assert.equal(await tileOf(one), "first: 1/dem.twz");
  assert.equal(await tileOf(other), "second: 2/dem.twz");
  // By name: the later one.
  assert.equal(await load("twz://alps/rgb/5/3/4"), "first: a/alps.twz");
  assert.equal(await load("twz://dem/voids/5/3/4?color=dbe4e8"), "second: 2/dem.twz");
  await assert.rejects(load("twz://none/rgb/5/3/4"), /no such terrain/);
});
