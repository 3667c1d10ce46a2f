/** Sources of bytes: memory, a File or Blob, a URL by range requests, or the caller's own. */

import { ArgumentError, SourceError } from "./errors.js";
import { UrlSource } from "./url.js";

/**
 * Ranges with gaps between them are read in one go, the shortest gaps first, as in Python
 * (container/sources/ranges.py): a quarter of the bytes wanted or 64 KiB in any case, and one and a
 * half times the bytes wanted or 512 KiB while there are more requests than is aimed at.
 */
const FREE_GAPS = 1 << 16;
const FREE_GAPS_OF_MANY = 1 << 19;
const MOST_GAP = 1 << 20;
const AIMED_REQUESTS = 3;
const MOST_AT_ONCE = 1 << 23;
const PARALLEL = 6;

/** Return a source { size, head(n), read(start, end) } of what the caller has. */
export function openSource(from, options = {}) {
  if (typeof from === "string" || from instanceof URL) return new UrlSource(from, options);
  if (from instanceof ArrayBuffer || ArrayBuffer.isView(from)) {
    const { buffer = from, byteOffset = 0, byteLength } = from;
    const bytes = new Uint8Array(buffer, byteOffset, byteLength);
    return new RangedSource(byteLength, async (start, end) => bytes.subarray(start, end));
  }
  if (typeof Blob !== "undefined" && from instanceof Blob) {
    return new RangedSource(from.size, async (start, end) => from.slice(start, end).arrayBuffer());
  }
  if (from && typeof from.read === "function" && Number.isSafeInteger(from.size)) {
    return new RangedSource(from.size, (start, end) => from.read(start, end));
  }
  throw new ArgumentError("open takes a URL, a Blob, bytes, or an object with size and read");
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
    if (!(bytes instanceof Uint8Array) || bytes.length !== end - start) {
      throw new SourceError(`bytes ${start} to ${end}: ${bytes?.length} bytes came, not ${end - start}`);
    }
    return bytes;
  }
}

/** Pages of the index that are kept: each reader of a file asks for them. */
const N_PAGES = 512;

/** Reads what decoders ask for: many ranges at a time, in few requests. */
export class Ranges {
  #source;
  #pages = new Map(); // by place: promises, the oldest first

  constructor(source) {
    this.#source = source;
  }

  /** Return the bytes of { start, end, isPage }. */
  async read(ranges) {
    const kept = await Promise.all(ranges.map((range) => this.#pages.get(nameOf(range))));
    const missing = ranges.filter((_, i) => !kept[i]);
    const reading = readRanges(this.#source, missing);
    missing.forEach((range, i) => {
      if (range.isPage) this.#keep(nameOf(range), reading.then((found) => new Uint8Array(found[i])));
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
  const joined = source.gathers ? new Set() : gapsToBridge(order.map((i) => ranges[i]));
  const groups = [];
  order.forEach((i, number) => {
    const { start, end } = ranges[i];
    const last = groups.at(-1);
    if (joined.has(number) && end - last.start <= MOST_AT_ONCE) {
      last.end = Math.max(last.end, end);
      last.members.push(i);
    } else {
      groups.push({ start, end, members: [i] });
    }
  });
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
  const nAtOnce = source.gathers ? groups.length : Math.min(PARALLEL, groups.length);
  await Promise.all(Array.from({ length: nAtOnce }, work));
  return found;
}

/** Return the numbers of ranges, in order of place, to be read with those before them. */
function gapsToBridge(ranges) {
  const wanted = ranges.reduce((sum, { start, end }) => sum + end - start, 0);
  const free = Math.max(wanted / 4, FREE_GAPS);
  const most = Math.max(1.5 * wanted, FREE_GAPS_OF_MANY);
  const gaps = ranges.slice(1).map(({ start }, i) => ({ gap: start - ranges[i].end, number: i + 1 }));
  const bridged = new Set();
  let spent = 0;
  for (const { gap, number } of gaps.sort((a, b) => a.gap - b.gap)) {
    const isTooMany = ranges.length - bridged.size > AIMED_REQUESTS;
    if (gap > MOST_GAP || spent + gap > (isTooMany ? most : free)) break;
    spent += Math.max(gap, 0);
    bridged.add(number);
  }
  return bridged;
}
