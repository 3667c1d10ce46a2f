/** The page's half of the map in notebooks: what the kernel is asked, and when it counts as busy. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { setTimeout as pause } from "node:timers/promises";

import { Kernel, addressOf } from "../notebook/widget.js";

const MOST_BYTES = 1 << 23;

/** A widget's model whose kernel answers as it is told to: `answer` of each message. */
class Model {
  constructor(answer = () => {}) {
    this.asked = [];
    this.heard = new Map();
    this.answer = answer;
  }

  on(event, callback) {
    this.heard.set(event, callback);
  }

  off(event, callback) {
    if (this.heard.get(event) === callback) this.heard.delete(event);
  }

  send(message) {
    this.asked.push(message);
    queueMicrotask(() => this.answer(message));
  }

  tell(content, buffers = []) {
    this.heard.get("msg:custom")?.(content, buffers);
  }
}

/** Answers ranges with the low byte of each place. */
function bytes(model) {
  return ({ id, ranges }) => {
    const buffers = ranges.map(([start, end]) => {
      const padded = new Uint8Array(end - start + 3);
      for (let i = start; i < end; i++) padded[i - start + 3] = i;
      return new DataView(padded.buffer, 3);
    });
    model.tell({ id, taken: true });
    model.tell({ id }, buffers);
  };
}

function served() {
  const model = new Model();
  model.answer = bytes(model);
  return model;
}

test("ranges that are wanted at once are asked for by one message", async () => {
  const model = served();
  const kernel = new Kernel(model, () => {});
  const found = await Promise.all([[5, 9], [1000, 1002], [0, 1]].map(([a, b]) => kernel.read(a, b)));
  assert.deepEqual(found.map((part) => [...part]), [[5, 6, 7, 8], [232, 233], [0]]);
  assert.deepEqual(model.asked.map(({ what, ranges }) => [what, ranges]), [
    ["ranges", [[5, 9], [1000, 1002], [0, 1]]],
  ]);
});

test("no message asks for more than the kernel takes", async () => {
  const model = served();
  const kernel = new Kernel(model, () => {});
  const large = kernel.read(10, 2 * MOST_BYTES + 20);
  const small = Array.from({ length: 200 }, (_, i) => kernel.read(i, i + 1));
  const found = await large;
  assert.equal(found.length, 2 * MOST_BYTES + 10);
  assert.ok([0, 1, MOST_BYTES - 1, MOST_BYTES, found.length - 1].every((i) => found[i] === ((i + 10) & 255)));
  assert.deepEqual((await Promise.all(small)).map(([one]) => one), Array.from({ length: 200 }, (_, i) => i));
  for (const { ranges } of model.asked) {
    assert.ok(ranges.length <= 64);
    assert.ok(ranges.reduce((sum, [start, end]) => sum + end - start, 0) <= MOST_BYTES);
  }
});

test("four messages wait at a time, and the others follow", async () => {
  const model = new Model();
  const kernel = new Kernel(model, () => {});
  const reading = Promise.all(Array.from({ length: 9 }, (_, i) => kernel.read(i * MOST_BYTES, (i + 1) * MOST_BYTES)));
  await pause(30);
  assert.equal(model.asked.length, 4);
  model.answer = bytes(model);
  for (const message of [...model.asked]) model.answer(message);
  assert.equal((await reading).length, 9);
  assert.equal(model.asked.length, 9);
});

test("an error rejects its own question alone, with its name", async () => {
  const model = new Model();
  const kernel = new Kernel(model, () => {});
  const [one, other] = [kernel.ask("terrain"), kernel.ask("draw", { box: null })];
  const [first, second] = model.asked;
  model.tell({ id: first.id, error: { name: "StorageError", message: "a.twz is closed" } });
  model.tell({ id: "another view's", error: { name: "Error", message: "no" } });
  model.tell({ id: second.id, some: 1 });
  await assert.rejects(one, { name: "StorageError", message: "a.twz is closed" });
  assert.equal((await other).some, 1);
});

test("reads go on after one that failed", async () => {
  const model = new Model(({ id }) => model.tell({ id, error: { name: "Error", message: "gone" } }));
  const kernel = new Kernel(model, () => {});
  await assert.rejects(kernel.read(0, 5), /gone/);
  model.answer = bytes(model);
  assert.deepEqual([...(await kernel.read(3, 5))], [3, 4]);
});

test("a kernel that does not hear for a second is busy, until it hears", async () => {
  const lines = [];
  const model = new Model();
  const kernel = new Kernel(model, (line) => lines.push(line));
  const answer = kernel.ask("terrain");
  await pause(900);
  assert.deepEqual(lines, []);
  await pause(250);
  assert.match(lines.pop(), /^The kernel is busy, or there is none: /);
  model.tell({ id: model.asked[0].id, taken: true });
  assert.equal(lines.pop(), "");
  await pause(1200); // it has heard, and reads: that is no busy kernel
  assert.deepEqual(lines, []);
  model.tell({ id: model.asked[0].id });
  await answer;
  kernel.ask("terrain").catch(() => {});
  await pause(1150);
  assert.equal(lines.at(-1), "The kernel is busy: the map waits, and goes on by itself.");
  kernel.end();
});

test("a kernel that has heard one question, and not the next one, is busy a second later", async () => {
  const lines = [];
  const model = new Model();
  const kernel = new Kernel(model, (line) => lines.push(line));
  for (const what of ["page", "terrain"]) kernel.ask(what).catch(() => {});
  model.tell({ id: model.asked[0].id, taken: true });
  await pause(1150);
  assert.deepEqual(lines, ["", "The kernel is busy: the map waits, and goes on by itself."]);
  kernel.end();
});

test("a kernel that hears all within a second is never busy, however much is asked", async () => {
  const lines = new Set();
  const model = new Model(({ id }) => setTimeout(() => model.tell({ id, taken: true }), 300));
  const kernel = new Kernel(model, (line) => lines.add(line));
  for (let i = 0; i < 16; i++) { // there is always one that has not been heard
    kernel.ask("terrain").catch(() => {});
    await pause(100);
  }
  assert.deepEqual([...lines], [""]);
  kernel.end();
});

test("a kernel that has ended is said, once, and to all who wait", async () => {
  const lines = [];
  const model = new Model();
  const kernel = new Kernel(model, (line) => lines.push(line));
  const asked = kernel.ask("terrain");
  model.heard.get("comm_live_update")();
  await assert.rejects(asked, /has ended/);
  await assert.rejects(kernel.read(0, 5), /has ended/);
  await pause(1100);
  assert.deepEqual(lines, ["The kernel of this map has ended: run the cell again."]);
  assert.equal(model.heard.size, 0);
});

test("views of one map do not take one another's answers", async () => {
  const model = new Model();
  const [one, other] = [new Kernel(model, () => {}), new Kernel(model, () => {})];
  one.ask("terrain");
  other.ask("terrain");
  assert.notEqual(model.asked[0].id, model.asked[1].id);
  assert.ok(model.asked.every(({ id }) => id.length <= 80));
});

const textAt = async (address) => (await fetch(address)).text();

test("files find one another by addresses of their own", async () => {
  const address = addressOf("index.html", {
    "index.html": '<link rel="icon" href="data:,"><link href="static/a/b.css"><script src="static/page.js">',
    "static/a/b.css": "p {}",
    "static/page.js": 'import { x } from "../reader/map/x.js";\nexport { y } from "./y.js";',
    "static/y.js": 'export const y = await import("./z.js");\nimport "./z.js";',
    "static/z.js": "export default 1;",
    "reader/map/x.js": 'export const x = new Worker(new URL("./w.js", import.meta.url), { type: "module" });',
    "reader/map/w.js": 'import "../x.js";',
    "reader/x.js": 'postMessage(" from a worker");',
  });
  const page = await textAt(address);
  const [css, script] = page.match(/blob:[^"]+/g);
  assert.match(page, /href="data:,"/);
  assert.equal(await textAt(css), "p {}");
  const [x, y] = (await textAt(script)).match(/blob:[^"]+/g);
  const z = (await textAt(y)).match(/blob:[^"]+/g);
  assert.equal(z.length, 2);
  assert.equal(new Set(z).size, 1);
  const made = await textAt(x);
  assert.match(made, /^export const x = new Worker\("blob:[^"]+", \{ type: "module" \}\);$/);
  const worker = await textAt(made.match(/blob:[^"]+/)[0]);
  assert.equal(await textAt(worker.match(/blob:[^"]+/)[0]), 'postMessage(" from a worker");');
});

test("a file that is missing is named", () => {
  assert.throws(() => addressOf("a.js", { "a.js": 'import "./b.js";' }), /the map lacks b\.js/);
});
