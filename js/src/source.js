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
