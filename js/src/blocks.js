/** A source that asks for whole blocks of a file, once each, those of many readers together. */

/** Bytes of a block: about what a connection brings in the time that it takes to ask. */
export const BLOCK = 1 << 17;
/** Blocks that may lie unused between two that are asked for at once. */
const MAX_GAP = 3;
const MOST_AT_ONCE = 64;
/** Milliseconds in which wishes are gathered: tiles of one view come one after another. */
const GATHERING = 10;
/** Blocks that are kept. */
const N_KEPT = 512;

/** Readers of many tiles ask at the same time: what they want is gathered before it is fetched. */
export class BlockSource {
  /** `source` has head(n), read(start, end) and, after the first head, size. */
  constructor(source) {
    this.source = source;
    this.gathers = true; // for readRanges: it joins what is asked for at the same time
    this.blocks = new Map(); // by number: promises, the least recently used first
    this.wanted = new Map(); // by number: what settles the promise
  }

  get size() {
    return this.source.size;
  }

  async head(n) {
    const bytes = await this.source.head(Math.max(n, BLOCK));
    if (bytes.length >= Math.min(BLOCK, this.size)) {
      this.blocks.set(0, Promise.resolve(bytes.subarray(0, BLOCK)));
    }
    return bytes.subarray(0, n);
  }

  async read(start, end) {
    const first = Math.floor(start / BLOCK);
    const numbers = Array.from({ length: Math.ceil(end / BLOCK) - first }, (_, i) => first + i);
    const blocks = await Promise.all(numbers.map((number) => this.block(number)));
    if (blocks.length === 1) return blocks[0].subarray(start - first * BLOCK, end - first * BLOCK);
    const found = new Uint8Array(end - start);
    blocks.forEach((bytes, i) => {
      const at = (first + i) * BLOCK;
      const part = bytes.subarray(Math.max(start - at, 0), end - at);
      found.set(part, Math.max(at - start, 0));
    });
    return found;
  }

  block(number) {
    let found = this.blocks.get(number);
    if (found) {
      this.blocks.delete(number);
    } else {
      found = new Promise((resolve, reject) => {
        if (this.wanted.size === 0) setTimeout(() => this.fetchWanted(), GATHERING);
        this.wanted.set(number, { resolve, reject });
      });
    }
    this.blocks.set(number, found);
    for (const oldest of this.blocks.keys()) {
      if (this.blocks.size <= N_KEPT) break;
      this.blocks.delete(oldest);
    }
    return found;
  }

  fetchWanted() {
    const { wanted } = this;
    this.wanted = new Map();
    const runs = [];
    for (const number of [...wanted.keys()].sort((a, b) => a - b)) {
      const last = runs.at(-1);
      if (last && number - last.end <= MAX_GAP && number - last.first < MOST_AT_ONCE) {
        last.end = number + 1;
      } else {
        runs.push({ first: number, end: number + 1 });
      }
    }
    for (const run of runs) this.fetchRun(run, wanted);
  }

  async fetchRun({ first, end }, wanted) {
    let bytes;
    try {
      bytes = await this.source.read(first * BLOCK, Math.min(end * BLOCK, this.size));
    } catch (error) {
      for (let number = first; number < end; number++) {
        this.blocks.delete(number); // another try asks anew
        wanted.get(number)?.reject(error);
      }
      return;
    }
    for (let number = first; number < end; number++) {
      const from = (number - first) * BLOCK;
      const part = bytes.subarray(from, from + BLOCK);
      if (wanted.has(number)) wanted.get(number).resolve(part);
      else if (!this.blocks.has(number)) this.blocks.set(number, Promise.resolve(part));
    }
  }
}
