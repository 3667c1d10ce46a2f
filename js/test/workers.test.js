/** Units decoded by workers: the same bytes, errors that are said, an end. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { ArgumentError, CorruptStreamError, TerrainwaveError, open } from "../src/index.js";
import { WorkerPool } from "../src/workers.js";
import { Parts, digests, golden } from "../testing/files.js";

const NAMES = ["store-int16-segments", "predictive-fast-blocks", "rapid-float32-exact",
  "rapid-fills-int16-nodata", "predictive-fills-float32-rings"];

for (const name of NAMES) {
  test(`${name}: the same with 0, 1 and 3 workers`, async () => {
    const bytes = await golden(name);
    const expected = await digests(await open(bytes, { workers: 0 }));
    for (const workers of [1, 3]) {
      const terrain = await open(bytes, { workers });
      const { heights } = await terrain.read(-1);
      const together = await Promise.all([terrain.read(-1), terrain.read(-1), terrain.read(-2)]);
      assert.deepEqual(together[1].heights, heights);
      assert.deepEqual(await digests(terrain), expected);
      await terrain.close();
      await assert.rejects(terrain.read(0), ArgumentError);
    }
  });
}

test("what a worker refuses has the class of its error", async () => {
  const parts = new Parts(await golden("rapid-int16-states"));
  parts.payloads = parts.payloads.map((payload) => payload.map(() => 255));
  const terrain = await open(parts.bytes(), { workers: 2 });
  await assert.rejects(terrain.read(), CorruptStreamError);
  await terrain.close();
});

const module = (text) => new URL(`data:text/javascript,${encodeURIComponent(text)}`);
const ANSWERS = `import { parentPort } from "node:worker_threads";
parentPort.on("message", ({ id, what }) =>
  what === "open" ? parentPort.postMessage({ id, found: {} }) : process.exit(3));`;

test("a worker that cannot start, one that ends and one that is closed are errors", async () => {
  const refused = (pattern) => (error) => error instanceof TerrainwaveError && pattern.test(error);
  const nothing = { message: { what: "decode" }, moved: [] };
  await assert.rejects(WorkerPool.start(2, { what: "open" }, module("throw new Error('no')")),
    refused(/worker failed: no/));
  const ending = await WorkerPool.start(2, { what: "open" }, module(ANSWERS));
  await assert.rejects(ending.ask(() => nothing), refused(/it ended/));
  await assert.rejects(ending.ask(() => nothing), refused(/it ended/));
  ending.close();
  const closed = await WorkerPool.start(1, { what: "open" }, module(ANSWERS));
  const asked = closed.ask(() => ({ message: { what: "open" }, moved: [] }));
  closed.close();
  await assert.rejects(asked, refused(/it was closed/));
});

test("numbers of workers are checked", async () => {
  const bytes = await golden("rapid-uint8");
  for (const workers of [-1, 0.5, 65, "2"]) await assert.rejects(open(bytes, { workers }), ArgumentError);
});
