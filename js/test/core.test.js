/** The decoder as WebAssembly: what a page that forbids it is told, and what happens where it breaks off. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Core } from "../src/core.js";
import { Engine } from "../src/engine.js";
import { CorruptStreamError, SourceError, TerrainwaveError, open } from "../src/index.js";
import { loadModule } from "../src/module.js";
import { golden } from "../testing/files.js";

test("its memory has a limit, and nothing is imported", async () => {
  const module = await loadModule();
  assert.deepEqual(WebAssembly.Module.imports(module), []);
  const { exports } = await WebAssembly.instantiate(module);
  assert.throws(() => exports.memory.grow(2 ** 15), RangeError); // of 64 KiB each: more than 2 GiB
});

test("pages that forbid WebAssembly are told which header to send, old browsers what they lack", async (context) => {
  const compile = context.mock.method(WebAssembly, "compile", async () => {
    throw new WebAssembly.CompileError("refused by the policy");
  });
  const refused = (pattern) => (error) => error instanceof TerrainwaveError && pattern.test(error);
  const { loadModule: load } = await import("../src/module.js?fresh");
  await assert.rejects(load(), refused(/Content-Security-Policy.*script-src 'self' 'wasm-unsafe-eval'.*refused/));
  context.mock.method(WebAssembly, "validate", () => false);
  await assert.rejects(load(), refused(/lacks SIMD/));
  compile.mock.restore();
  assert.ok((await load()) instanceof WebAssembly.Module); // another try
});

test("it refuses to digest a tile that is too large, or was not given, whoever asks", async () => {
  const bytes = await golden("rapid-int16-halves");
  const { exports } = await WebAssembly.instantiate(await loadModule());
  const numbers = () => new Float64Array(exports.memory.buffer, exports.numbers(), 2);
  assert.equal(exports.begin_file(bytes.length, 2 ** 20, 2 ** 24), 0);
  while (exports.file_need() > 0) {
    const [start, length] = numbers();
    const at = exports.room_for(length);
    new Uint8Array(exports.memory.buffer, at, length).set(bytes.subarray(start, start + length));
    assert.equal(exports.feed_file(start, length), 0);
  }
  exports.room_for(3 * 512 * 512);
  assert.equal(exports.digest_given(512, 512), 0);
  for (const shape of [[513, 1], [1, 513], [2 ** 31, 2]]) assert.equal(exports.digest_given(...shape), 5);
});

/** A decoder that begins files, and traps where it is asked what it needs. */
function trapping() {
  const name = (text) => [text.length, ...Buffer.from(text)];
  const section = (id, bytes) => [id, bytes.length, ...bytes];
  return new WebAssembly.Module(Uint8Array.from([
    0, 0x61, 0x73, 0x6d, 1, 0, 0, 0,
    ...section(1, [2, 0x60, 3, 0x7c, 0x7c, 0x7c, 1, 0x7f, 0x60, 0, 1, 0x7f]),
    ...section(3, [2, 0, 1]),
    ...section(7, [2, ...name("begin_file"), 0, 0, ...name("file_need"), 0, 1]),
    ...section(10, [2, 4, 0, 0x41, 0, 0x0b, 3, 0, 0x00, 0x0b]),
  ]));
}

test("a trap is an error of the file, and of it alone", async (context) => {
  const engine = new Engine({ module: trapping(), size: 200, start: new Uint8Array(200), cacheBytes: 0 });
  const instantiate = context.mock.method(WebAssembly, "instantiate");
  for (let time = 1; time <= 2; time++) {
    await assert.rejects(engine.describe(), (error) =>
      error instanceof CorruptStreamError && error.cause instanceof WebAssembly.RuntimeError);
    assert.equal(instantiate.mock.callCount(), time); // what broke off is not asked again
  }
  await engine.close();
  assert.ok(await (await open(await golden("rapid-uint8"))).read());
});

test("a decoder that broke off while a window was read is replaced for the next one", async (context) => {
  const terrain = await open(await golden("rapid-int16-halves"));
  const { heights } = await terrain.read();
  const instantiate = context.mock.method(WebAssembly, "instantiate");
  const read = context.mock.method(Core.prototype, "read", function broken() {
    this.isBroken = true;
    throw new CorruptStreamError("it broke off");
  });
  await assert.rejects(terrain.read(), /it broke off/);
  assert.equal(instantiate.mock.callCount(), 0);
  read.mock.restore();
  assert.deepEqual((await terrain.read()).heights, heights);
  assert.equal(instantiate.mock.callCount(), 1);
});

test("a closed file leaves its memory empty to the next one", async (context) => {
  const bytes = await golden("rapid-int16-halves");
  await (await open(bytes)).close();
  const instantiate = context.mock.method(WebAssembly, "instantiate");
  for (let time = 0; time < 100; time++) { // 1.5 MB of tables each
    const terrain = await open(bytes);
    await terrain.read();
    await terrain.close();
  }
  assert.equal(instantiate.mock.callCount(), 0);
});

test("bytes that do not come are an error, not another request for ever", async () => {
  const bytes = await golden("rapid-int16-halves");
  const engine = new Engine({ module: await loadModule(), size: bytes.length, start: bytes.subarray(0, 100), cacheBytes: 0 });
  await assert.rejects(engine.describe(async (ranges) => ranges.map(() => new Uint8Array(3))), SourceError);
  const about = await engine.describe(async (ranges) => ranges.map(({ start, end }) => bytes.subarray(start, end)));
  assert.equal(about.nRows, 110); // another try
});
