/** Where bytes come from: memory, a File or Blob, a URL by range requests, or the caller's own. */

import { ArgumentError, SourceError } from "./errors.js";
import { UrlSource } from "./url.js";

/** Ranges closer together than this are read in one go. */
const GAP = 8192;
const MOST_AT_ONCE = 1 << 23;
const PARALLEL = 6;

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

/** Pages of the index that are kept: each reader of a file asks for them. */
const N_PAGES = 512;
/** Where no more pages are needed at once, what is likely to be needed behind them is announced. */
const FEW_PAGES = 8;

/** Reads what decoders ask for: many ranges at a time, in few requests. */
export class Ranges {
  #source;
  #pages = new Map(); // by place: promises, the oldest first

  constructor(source) {
    this.#source = source;
  }

  /** Return the bytes of { start, end, likely }; so many bytes behind one are likely to be next. */
  async read(ranges) {
    const kept = await Promise.all(ranges.map((range) => this.#pages.get(nameOf(range))));
    const missing = ranges.filter((_, i) => !kept[i]);
    const pages = missing.filter(({ likely }) => likely > 0);
    if (pages.length <= FEW_PAGES) {
      for (const { end, likely } of pages) this.#source.announce?.(end, end + likely);
    }
    const reading = readRanges(this.#source, missing);
    missing.forEach((range, i) => {
      if (range.likely > 0) this.#keep(nameOf(range), reading.then((found) => new Uint8Array(found[i])));
    });
    const found = (await reading).values();
    return kept.map((bytes) => bytes ?? found.next().value);
  }

  #keep(name, page) {
    this.#pages.set(name, page);
    page.catch(() => this.#pages.delete(name)); // another read asks again
    if (this.#pages.size > N_PAGES) this.#pages.delete(this.#pages.keys().next().value);
  }
}

const nameOf = ({ start, end }) => `${start}-${end}`;

/** Return the bytes of ranges in any order, those that lie close together by one request. */
async function readRanges(source, ranges) {
  const found = new Array(ranges.length);
  const order = ranges.map((_, i) => i).sort((a, b) => ranges[a].start - ranges[b].start);
  const groups = [];
  for (const i of order) {
    const { start, end } = ranges[i];
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
        found[i] = bytes.subarray(ranges[i].start - start, ranges[i].end - start);
      }
    }
  };
  await Promise.all(Array.from({ length: Math.min(source.parallel ?? PARALLEL, groups.length) }, work));
  return found;
}
