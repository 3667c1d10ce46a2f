/** Where bytes come from: memory, a File or Blob, a URL by range requests, or the caller's own. */

import { ArgumentError, LimitExceededError, SourceError } from "./errors.js";

/** Ranges closer together than this are read in one go. */
const GAP = 8192;
const MOST_AT_ONCE = 1 << 23;
const PARALLEL = 6;
/** A file of a server that sends no ranges is taken whole up to so many bytes, as by Python. */
export const MOST_WHOLE = 1 << 26;

/** Return a source { size, head(n), read(start, end) } of what the caller has. */
export function openSource(from, options = {}) {
  if (typeof from === "string" || from instanceof URL) return new UrlSource(from, options);
  if (from instanceof ArrayBuffer) return new BytesSource(new Uint8Array(from));
  if (ArrayBuffer.isView(from)) {
    return new BytesSource(new Uint8Array(from.buffer, from.byteOffset, from.byteLength));
  }
  if (typeof Blob !== "undefined" && from instanceof Blob) {
    return new RangedSource(from.size, async (start, end) => from.slice(start, end).arrayBuffer());
  }
  if (from && typeof from.read === "function" && Number.isSafeInteger(from.size)) {
    return new RangedSource(from.size, (start, end) => from.read(start, end));
  }
  throw new ArgumentError("open takes a URL, a Blob, bytes, or an object with size and read");
}

class BytesSource {
  constructor(bytes) {
    this.bytes = bytes;
    this.size = bytes.length;
  }

  async head(n) {
    return this.bytes.subarray(0, n);
  }

  async read(start, end) {
    return this.bytes.subarray(start, end);
  }
}

class RangedSource {
  constructor(size, readRange) {
    this.size = size;
    this.readRange = readRange;
  }

  head(n) {
    return this.read(0, Math.min(n, this.size));
  }

  async read(start, end) {
    let found;
    try {
      found = await this.readRange(start, end);
    } catch (cause) {
      throw new SourceError(`bytes ${start} to ${end}: ${cause.message}`, { cause });
    }
    const bytes = found instanceof ArrayBuffer ? new Uint8Array(found) : found;
    return exactly(bytes, end - start, `bytes ${start} to ${end}`);
  }
}

function exactly(bytes, n, what) {
  if (!(bytes instanceof Uint8Array) || bytes.length !== n) {
    throw new SourceError(`${what}: ${bytes?.length} bytes came, not ${n}`);
  }
  return bytes;
}

class UrlSource {
  constructor(url, { fetch = globalThis.fetch, headers = {}, signal } = {}) {
    if (typeof fetch !== "function") throw new ArgumentError("there is no fetch here: pass one");
    this.url = String(url);
    this.fetch = fetch;
    this.options = { headers, signal };
    this.size = null;
    this.tag = null;
    this.whole = null; // of a server that knows no ranges
  }

  async head(n) {
    const bytes = await this.ask(0, n);
    return bytes.subarray(0, n);
  }

  async read(start, end) {
    const bytes = await this.ask(start, end);
    return exactly(bytes, end - start, `${this.url}: bytes ${start} to ${end}`);
  }

  async ask(start, end) {
    if (this.whole) return this.whole.subarray(start, end);
    const { headers, signal } = this.options;
    let response;
    let body;
    try {
      const range = `bytes=${start}-${end - 1}`;
      // Called unbound: browsers' fetch refuses another `this`.
      const { fetch } = this;
      response = await fetch(this.url, { headers: { ...headers, Range: range }, signal });
      if (response.status === 200) body = await wholeBody(response, this.url);
      else if (response.ok) body = new Uint8Array(await response.arrayBuffer());
    } catch (cause) {
      if (cause instanceof LimitExceededError) throw cause;
      throw new SourceError(`${this.url}: ${cause.message}`, { cause });
    }
    if (response.status === 200) {
      this.compare(response, body.length);
      this.whole = body;
      return body.subarray(start, end);
    }
    const range = /^bytes (\d+)-(\d+)\/(\d+)$/.exec(response.headers.get("content-range") ?? "");
    if (response.status !== 206 || range === null) {
      throw new SourceError(`${this.url}: HTTP status ${response.status} to a request of a range`);
    }
    const [first, last, size] = range.slice(1).map(Number);
    if (first !== start || last !== Math.min(end, size) - 1 || body.length !== last + 1 - first) {
      throw new SourceError(`${this.url}: other bytes than asked for`);
    }
    this.compare(response, size);
    return body;
  }

  /** Refuse a file that changed since the first request. */
  compare(response, size) {
    const tag = response.headers.get("etag");
    if (this.size !== null && (this.size !== size || this.tag !== tag)) {
      throw new SourceError(`${this.url} changed while it was read`);
    }
    this.size = size;
    this.tag = tag;
  }
}

/** Return a body of at most `MOST_WHOLE` bytes. */
async function wholeBody(response, url) {
  const refuse = () => {
    throw new LimitExceededError(
      `${url}: the server sends no ranges, and of more than ${MOST_WHOLE >> 20} MiB not all is read`,
    );
  };
  // Of a coded body the length is another one; it cannot be longer.
  if (Number(response.headers.get("content-length")) > MOST_WHOLE) {
    await response.body?.cancel();
    refuse();
  }
  if (!response.body) return new Uint8Array(await response.arrayBuffer());
  const parts = [];
  let size = 0;
  const reader = response.body.getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    parts.push(part.value);
    size += part.value.length;
    if (size > MOST_WHOLE) {
      await reader.cancel();
      refuse();
    }
  }
  const whole = new Uint8Array(size);
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}

/**
 * Read many ranges [start, end), in any order, in few requests.
 *
 * Returns their bytes in the order of `ranges`; those of no length need no request.
 */
export async function readRanges(source, ranges) {
  const found = new Array(ranges.length);
  const order = ranges.map((_, i) => i).filter((i) => ranges[i][1] > ranges[i][0]);
  order.sort((a, b) => ranges[a][0] - ranges[b][0]);
  const groups = [];
  for (const i of order) {
    const [start, end] = ranges[i];
    const last = groups.at(-1);
    if (last && start - last.end <= GAP && end - last.start <= MOST_AT_ONCE) {
      last.end = Math.max(last.end, end);
      last.members.push(i);
    } else {
      groups.push({ start, end, members: [i] });
    }
  }
  let next = 0;
  const work = async () => {
    while (next < groups.length) {
      const { start, end, members } = groups[next++];
      const bytes = await source.read(start, end);
      for (const i of members) {
        found[i] = bytes.subarray(ranges[i][0] - start, ranges[i][1] - start);
      }
    }
  };
  await Promise.all(Array.from({ length: Math.min(source.parallel ?? PARALLEL, groups.length) }, work));
  return Array.from(found, (bytes) => bytes ?? new Uint8Array(0));
}
