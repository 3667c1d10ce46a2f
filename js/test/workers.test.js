/** Units decoded by workers: the same bytes, errors that are said, an end. */

import assert from "node:assert/strict";
import { execFile } from "node:child_process";
import { test } from "node:test";
import { fileURLToPath } from "node:url";
import { promisify } from "node:util";

import { ArgumentError, CorruptStreamError, TerrainwaveError, open } from "../src/index.js";
import { Mailbox } from "../src/mailbox.js";
import { WorkerPool } from "../src/workers.js";
import { GOLDEN, Parts, golden } from "../testing/files.js";
import { digests } from "../testing/levels.js";

const NAMES = ["store-int16-segments", "predictive-patched-float32-nan", "rapid-float32-fills",
  "rapid-int16-mask", "cdf97-int16-halves", "cdf53-int16-tiles"];

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
  what === "open" ? parentPort.postMessage({ id }) : process.exit(3));`;
const SILENT = ANSWERS.replace("process.exit(3)", "0");

test("a worker that cannot start, one that ends and one that is closed are errors", async () => {
  const refused = (pattern) => (error) => error instanceof TerrainwaveError && pattern.test(error);
  const start = (n, text) => WorkerPool.start(n, {}, async () => [], module(text));
  await assert.rejects(start(2, "throw new Error('no')"), refused(/worker failed: no/));
  const ending = await start(2, ANSWERS);
  await assert.rejects(ending.read({}, 0), refused(/it ended/));
  await assert.rejects(ending.read({}, 1), refused(/it ended/));
  assert.ok(ending.isBroken);
  ending.close();
  const closed = await start(1, SILENT);
  const asked = closed.read({}, 0);
  closed.close();
  await assert.rejects(asked, refused(/it was closed/));
});

test("where no worker can start the page decodes, and says so once", async (context) => {
  const warned = context.mock.method(console, "warn", () => {});
  globalThis.Worker = class {
    constructor() {
      throw new Error("a policy forbids it");
    }
  };
  try {
    const bytes = await golden("predictive-int16-halves");
    const terrain = await open(bytes, { workers: 2 });
    assert.deepEqual(await digests(terrain), await digests(await open(bytes)));
    await terrain.close();
  } finally {
    delete globalThis.Worker;
  }
  assert.equal(warned.mock.callCount(), 1);
  assert.match(warned.mock.calls[0].arguments[0], /a policy forbids it/);
});

test("idle workers let a process end", async () => {
  const program = `import("${new URL("../src/index.js", import.meta.url)}").then(async ({ open }) => {
    const terrain = await open(require("node:fs").readFileSync(process.argv[1]), { workers: 2 });
    console.log((await terrain.read()).heights.length);
  });`;
  const words = ["-e", program, fileURLToPath(new URL("rapid-int16-halves.twz", GOLDEN))];
  const { stdout, stderr } = await promisify(execFile)(process.execPath, words, { timeout: 60000 });
  assert.deepEqual([stdout, stderr], ["11000\n", ""]);
});

test("numbers of workers are checked", async () => {
  const bytes = await golden("rapid-uint8");
  for (const workers of [-1, 0.5, 65, "2"]) await assert.rejects(open(bytes, { workers }), ArgumentError);
});

test("a question that cannot be sent is refused, and nothing waits for its answer", async () => {
  const mailbox = new Mailbox({ postMessage: (question) => structuredClone(question) });
  await assert.rejects(mailbox.ask({ call: () => 1 }), { name: "DataCloneError" });
  assert.equal(mailbox.size, 0);
});
