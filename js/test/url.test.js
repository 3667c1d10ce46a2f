// What web servers answer, case by case: the table that both readers are held to, and this one's own.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { test } from "node:test";
import { gzipSync } from "node:zlib";

import { SourceError, TerrainwaveError } from "../src/errors.js";
import { open } from "../src/index.js";
import { MOST_WHOLE, POLICY, UrlSource } from "../src/url.js";
import { withLongHead } from "../testing/files.js";
import { lengthsOf } from "../testing/format.js";

const TABLE = JSON.parse(await readFile(new URL("../../tests/http_cases.json", import.meta.url)));
const DATA = Uint8Array.from({ length: 40000 }, (_, i) => (i * 7) % 251);
const [START, END] = [30000, 30100];
const PUBLISHED = { ...POLICY };

/** Return a header, a date where it is seconds from now. */
function inDates(value) {
  const seconds = /^([+-]\d+)s$/.exec(value);
  return seconds ? new Date(Date.now() + 1000 * Number(seconds[1])).toUTCString() : value;
}

function answer(spec, request, response) {
  if (spec.hang_up) return request.socket.destroy();
  if (spec.stall) return undefined;
  const status = spec.status ?? 206;
  const headers = {};
  for (const [name, value] of Object.entries(spec.headers ?? {})) headers[name] = inDates(value);
  let body = Buffer.from(spec.text ?? "");
  if (status === 200) {
    body = spec.gzip ? gzipSync(DATA) : DATA;
    if (spec.gzip) headers["Content-Encoding"] = "gzip";
  }
  if (status === 206) {
    const [first, most] = /^bytes=(\d+)-(\d+)$/.exec(request.headers.range).slice(1).map(Number);
    const last = Math.min(most, DATA.length - 1);
    body = DATA.subarray(first, last + 1);
    if (!spec.bare) headers["Content-Range"] = spec.range ?? `bytes ${first}-${last}/${DATA.length}`;
  }
  body = body.subarray(0, body.length - (spec.short ?? 0));
  const sent = body.subarray(0, spec.cut ?? body.length);
  if (spec.drips) {
    response.writeHead(status, { ...headers, "Content-Length": body.length });
    const timer = setInterval(() => response.write(sent.subarray(0, 1)), 20);
    return response.on("close", () => clearInterval(timer));
  }
  if (spec.no_length) {
    response.useChunkedEncodingByDefault = false;
    response.shouldKeepAlive = false;
  } else headers["Content-Length"] = body.length;
  response.writeHead(status, headers);
  if (sent.length === body.length || spec.no_length) return response.end(sent);
  return response.write(sent, () => setTimeout(() => request.socket.destroy(), 20));
}

/** Call `use` with the address of a server that gives these replies, and what it was asked. */
async function serving(replies, use) {
  const left = [...replies];
  const asked = [];
  const server = createServer((request, response) => {
    asked.push(request);
    answer(left.length > 1 ? left.shift() : left[0], request, response);
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  try {
    return await use(`http://127.0.0.1:${server.address().port}`, asked);
  } finally {
    server.closeAllConnections?.();
    server.close();
  }
}

async function outcome(address, options, policy) {
  const waits = [];
  Object.assign(POLICY, { wait: async (seconds) => waits.push(seconds), silence: 1, ...policy });
  try {
    const source = new UrlSource(address, options);
    await source.head(16384);
    return { bytes: await source.read(START, END), waits };
  } catch (error) {
    if (!(error instanceof TerrainwaveError)) throw error;
    return { error: error.message, waits };
  } finally {
    Object.assign(POLICY, PUBLISHED);
  }
}

async function check({ replies, query = "", login = "", error = "", waits, within = 0, requests }) {
  await serving(replies, async (host, asked) => {
    const address = `${host}/dir/a.twz`;
    const found = await outcome((login ? address.replace("://", `://${login}@`) : address) + query);
    const expected = error.replace("NAME", address);
    if (!expected) assert.deepEqual(found.bytes, DATA.subarray(START, END), found.error);
    else if (expected.endsWith("…")) assert.ok(found.error?.startsWith(expected.slice(0, -1)), found.error);
    else assert.equal(found.error, expected);
    if (within === 0) assert.deepEqual(found.waits, waits);
    else found.waits.forEach((wait, i) => assert.ok(Math.abs(wait - waits[i]) <= within));
    if (requests !== undefined) assert.equal(asked.length, requests);
  });
}

for (const one of TABLE.cases) test(`a case of the table: ${one.name}`, () => check(one));

const { retried, final, delays } = TABLE.policy;

for (const [status, words] of Object.entries(retried)) {
  test(`a server that answers ${status} may have time later: it is asked three times`, async () => {
    const reply = { status: Number(status) };
    const error = `cannot read NAME: HTTP status ${status} ${words}`;
    await check({ replies: [reply, {}], requests: 3, waits: [0.2] });
    await check({ replies: [reply], requests: 3, waits: delays, error });
    await check({ replies: [{}, reply], requests: 4, waits: delays, error });
  });
}

for (const [status, words] of Object.entries(final)) {
  test(`a server that answers ${status} is asked once`, async () => {
    const error = `cannot read NAME: HTTP status ${status} ${words}`;
    await check({ replies: [{ status: Number(status) }], requests: 1, waits: [], error });
  });
}

for (const { url, asked: expected } of TABLE.addresses) {
  test(`${url} is asked for as servers take it`, () =>
    serving([{}], async (host, asked) => {
      assert.ok((await outcome(host + url)).bytes);
      assert.deepEqual([...new Set(asked.map((request) => request.url))], [expected]);
    }));
}

test("the numbers are those of the table", () => {
  assert.deepEqual(POLICY.busy.map(String), Object.keys(retried));
  assert.deepEqual(POLICY.delays, delays);
  assert.equal(POLICY.longestWait, TABLE.policy.longest_wait);
  assert.equal(POLICY.silence, TABLE.policy.silence);
  assert.equal(POLICY.leastRate, TABLE.policy.least_rate);
  assert.equal(MOST_WHOLE, TABLE.policy.whole_mib * 2 ** 20);
});

test("a server that sends a byte now and then is given up, and not asked again", () =>
  serving([{ drips: true }], async (host, asked) => {
    const { error, waits } = await outcome(`${host}/a`, {}, { leastRate: 1e9 });
    const words = "the server has not sent 16,384 bytes in 1 s; try again later";
    assert.equal(error, `cannot read ${host}/a: ${words}`);
    assert.deepEqual([asked.length, waits], [1, []]);
  }));

test("parts are asked for uncompressed", () =>
  serving([{}], async (host, asked) => {
    await outcome(host + "/a");
    assert.deepEqual(asked.map((request) => request.headers["accept-encoding"]), ["identity", "identity"]);
  }));

test("user and password go to the server and into no message", () =>
  serving([{}, { status: 404 }], async (host, asked) => {
    const { error } = await outcome(`${host.replace("//", "//me:se%40cr%C3%A9t@")}/a?token=hidden`);
    assert.equal(error, `cannot read ${host}/a: HTTP status 404 Not Found`);
    const login = `Basic ${Buffer.from("me:se@crét").toString("base64")}`;
    assert.deepEqual(asked.map((request) => request.headers.authorization), [login, login]);
  }));

test("a redirect to spaces and other letters is followed", () =>
  serving([{}], async (other, asked) => {
    const location = encodeURI(`${other}/größe 1.twz`);
    await serving([{ status: 302, headers: { Location: location } }], async (host) => {
      assert.ok((await outcome(host + "/a")).bytes);
    });
    assert.equal(asked[0].url, "/gr%C3%B6%C3%9Fe%201.twz");
  }));

test("a server that is not there is asked once", async () => {
  const gone = await serving([{}], async (host) => host);
  const { error, waits } = await outcome(`${gone}/a`);
  assert.match(error, /^cannot read http.*ECONNREFUSED/);
  assert.deepEqual(waits, []);
});

test("a signal ends the waiting", () =>
  serving([{ status: 503, headers: { "Retry-After": "9" } }], async (host, asked) => {
    const controller = new AbortController();
    setTimeout(() => controller.abort(), 200);
    const source = new UrlSource(`${host}/a`, { signal: controller.signal });
    const start = Date.now();
    await assert.rejects(source.head(16), (error) => error instanceof DOMException && error.name === "AbortError");
    assert.ok(Date.now() - start < 5000);
    assert.equal(asked.length, 1);
  }));

test("a signal ends a request, which is not made again", () =>
  serving([{ stall: true }], async (host, asked) => {
    const controller = new AbortController();
    const reason = new Error("enough");
    setTimeout(() => controller.abort(reason), 200);
    const source = new UrlSource(`${host}/a`, { signal: controller.signal });
    await assert.rejects(source.head(16), (error) => error === reason);
    assert.equal(asked.length, 1);
  }));

test("a signal that is given to open ends what is read later, by workers too, with its reason", async () => {
  const bytes = await withLongHead("rapid-float32-fills");
  const endOfHead = lengthsOf(bytes).reduce((sum, n) => sum + n, 128);
  for (const workers of [0, 2]) {
    for (const isUrl of [true, false]) {
      const controller = new AbortController();
      const reason = new Error("enough");
      const read = async (start, end) => {
        if (end > endOfHead) controller.abort(reason);
        controller.signal.throwIfAborted();
        return bytes.subarray(start, end);
      };
      const fetch = async (url, { headers: { Range } }) => {
        const [first, last] = Range.match(/\d+/g).map(Number);
        const part = await read(first, last + 1);
        const range = `bytes ${first}-${first + part.length - 1}/${bytes.length}`;
        return new Response(part, { status: 206, headers: { "content-range": range } });
      };
      const from = isUrl ? "http://host/a.twz" : { size: bytes.length, read };
      const terrain = await open(from, { fetch, signal: controller.signal, workers });
      await assert.rejects(terrain.read(), (error) => error === reason);
      await assert.rejects(terrain.read(0), (error) => error === reason);
      await terrain.close();
      await assert.rejects(open(bytes, { signal: controller.signal }), (error) => error === reason);
    }
  }
});

test("a reply that hides its Content-Range from pages of other origins names the header", async () => {
  const fetch = async () => {
    const response = new Response(DATA.subarray(0, 16), { status: 206 });
    return Object.defineProperty(response, "type", { value: "cors" });
  };
  await assert.rejects(new UrlSource("https://host/a.twz", { fetch }).head(16), (error) =>
    error instanceof SourceError && /Access-Control-Expose-Headers: Content-Range/.test(error));
});
