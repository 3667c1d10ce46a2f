/** A terrain: what users hold. */

import { BlockSource } from "./blocks.js";
import { ARRAYS } from "./core.js";
import { Engine } from "./engine.js";
import { ArgumentError, LimitExceededError } from "./errors.js";
import { loadModule } from "./module.js";
import { Ranges, openSource } from "./source.js";
import { WorkerPool, numberOfWorkers } from "./workers.js";

const DEFAULTS = { cacheBytes: 2 ** 27, maxSamples: 2 ** 28 };
/** Most files are opened by one request of so many bytes (FORMAT.md §10). */
const FIRST_READ = 16384;
/** A feature of FORMAT.md §4.1: samples of coarse levels tell whether the full grid has them. */
const HAS_VOIDS = 1; // feature bit 0
/** Samples that are read at once: a decoder's memory holds them of any raster. */
const MOST_AT_ONCE = 2 ** 23;
/** Of larger windows: samples on a side of their parts, at least. */
const SIDE = 2048;
/** Parts of a window that are read at once by each thread: bytes come while others are decoded. */
const PARTS_AT_ONCE = 3;
/** Smaller windows are read here: workers take their time to start. */
const FEWEST_UNITS_FOR_WORKERS = 3;
/** Meanings of the numbers, by FORMAT.md §4.2. */
const KINDS = ["height", "depth", "radius"];
/** Workers that nobody asked for start with a window that takes longer than they need to start. */
const FEWEST_SAMPLES_TO_START = 2 ** 21;

/** Open a .twz file: a URL, a File or Blob, bytes, or an object { size, read(start, end) }. */
export async function open(from, options = {}) {
  const { cacheBytes, maxSamples, workers, blocks, signal } = { ...DEFAULTS, ...options };
  const nWorkers = numberOfWorkers(workers);
  signal?.throwIfAborted();
  const found = openSource(from, options);
  const source = blocks ? new BlockSource(found) : found;
  const [head, module] = await Promise.all([source.head(FIRST_READ), loadModule()]);
  // A copy: the head may be part of much more, which would go to workers with it.
  const file = { module, size: source.size, start: new Uint8Array(head), cacheBytes };
  const ranges = new Ranges(source);
  const fetch = async (wanted) => {
    try {
      signal?.throwIfAborted();
      return await ranges.read(wanted);
    } catch (error) {
      signal?.throwIfAborted(); // its reason, whatever the source makes of it
      throw error;
    }
  };
  const engine = new Engine(file);
  const about = await engine.describe(fetch);
  const fewestSamples = workers === undefined ? FEWEST_SAMPLES_TO_START : 0;
  return new Terrain({ file, engine, fetch, nWorkers, fewestSamples, maxSamples, signal }, about);
}

/** Split a window at multiples of `side`: units lie between them, the last one with a line more. */
function partsOf({ row, col, nRows, nCols }, shape, side) {
  const cut = (first, n, nOfLevel) => {
    const places = [first];
    for (let at = first - (first % side) + side; at < Math.min(first + n, nOfLevel - 1); at += side) places.push(at);
    return places.map((at, i) => [at, (places[i + 1] ?? first + n) - at]);
  };
  return cut(row, nRows, shape.nRows).flatMap(([top, height]) =>
    cut(col, nCols, shape.nCols).map(([left, width]) =>
      ({ row: top, col: left, nRows: height, nCols: width }),
    ),
  );
}

/** A multiresolution raster of heights. Level 0 is the coarsest, -1 the full grid. */
export class Terrain {
  #given;
  #pool = null; // a promise of workers, or of null
  #isClosed = false;

  constructor(given, { features, metadata: text, ...about }) {
    const all = Object.entries(JSON.parse(text)).filter(([, value]) => value !== null);
    const metadata = Object.fromEntries(all); // defines "__proto__" as a key like any other
    const { crs = null, units = null, scale = 1, offset = 0 } = metadata;
    const heightsAre = KINDS.includes(metadata.heights_are) ? metadata.heights_are : null;
    Object.assign(this, about, { metadata, crs, units, scale, offset, heightsAre, fileSize: given.file.size });
    this.hasVoids = (features & HAS_VOIDS) !== 0;
    this.#given = given;
    Object.freeze(this);
  }

  /** Number of a level, 0 … nLevels - 1; negative ones count from the finest. */
  #level(level) {
    const found = level < 0 ? level + this.nLevels : level;
    if (!Number.isInteger(found) || found < 0 || found >= this.nLevels) {
      throw new ArgumentError(`level ${level}: there are ${this.nLevels}`);
    }
    return found;
  }

  /** Return { nRows, nCols } of a level. */
  shape(level = -1) {
    const step = 2 ** (this.nLevels - 1 - this.#level(level));
    const [nRows, nCols] = [this.nRows, this.nCols].map((n) => Math.floor((n - 1) / step) + 1);
    return { nRows, nCols };
  }

  /**
   * Return [a, b, c, d, e, f]: x = a·col + b·row + c, y = d·col + e·row + f of a pixel's upper left
   * corner, as GDAL and rasterio have it. Samples are the centres of pixels.
   */
  transform(level = -1) {
    const cells = 2 ** (this.nLevels - 1 - this.#level(level));
    const [a, b, c, d, e, f] = this.metadata.transform ?? [1, 0, 0, 0, 1, 0];
    const shift = (1 - cells) / 2; // the first sample's centre stays
    return [a * cells, b * cells, c + (a + b) * shift, d * cells, e * cells, f + (d + e) * shift];
  }

  /** { left, bottom, right, top }: the pixels of the full grid. */
  get bounds() {
    const [a, b, c, d, e, f] = this.transform();
    const corners = [[0, 0], [0, this.nCols], [this.nRows, 0], [this.nRows, this.nCols]];
    const xs = corners.map(([row, col]) => a * col + b * row + c);
    const ys = corners.map(([row, col]) => d * col + e * row + f);
    return {
      left: Math.min(...xs), bottom: Math.min(...ys), right: Math.max(...xs), top: Math.max(...ys),
    };
  }

  /**
   * Read a window of a level.
   *
   * `window` is { row, col, nRows, nCols } in samples of the level, by default all of it; what lies
   * beyond the level is cut off. Returns
   * { heights, valid, level, row, col, nRows, nCols }: heights in the file's dtype and validity, 1
   * or 0, row by row. Void samples hold `nodata`, or NaN, or 0 in an integer dtype without one.
   *
   * `voids` says which samples of a coarse level are void: "exact", where the full grid is, sample
   * by sample, or "any", those alone around which nothing is valid, while the others have a height
   * that is a fill.
   */
  async read(level = -1, window = {}, { voids = "exact" } = {}) {
    const { maxSamples, signal } = this.#given;
    if (this.#isClosed) throw new ArgumentError("the terrain is closed");
    const found = this.#level(level);
    if (voids !== "exact" && voids !== "any") throw new ArgumentError(`voids ${voids}: expected "exact" or "any"`);
    const place = this.#cut(found, window ?? {});
    const { nRows, nCols } = place;
    if (nRows * nCols > maxSamples) {
      throw new LimitExceededError(`${nRows} x ${nCols} samples are more than maxSamples, ${maxSamples}`);
    }
    const isExact = voids === "exact" && this.hasVoids;
    const read = await this.#reader(found, place);
    const heights = new ARRAYS[this.dtype](nRows * nCols);
    const valid = new Uint8Array(nRows * nCols);
    const parts = partsOf(place, this.shape(found), read.side);
    const isPart = nRows * nCols > MOST_AT_ONCE;
    const rest = parts.entries();
    const work = async () => {
      for (const [i, part] of rest) {
        signal?.throwIfAborted();
        const start = (part.row - place.row) * nCols + part.col - place.col;
        const width = part.nCols;
        await read({ level: found, isExact, isPart, ...part }, i, (ofRows, validOfRows, row) => {
          const to = start + row * nCols;
          if (width === nCols) {
            heights.set(ofRows, to);
            valid.set(validOfRows, to);
            return;
          }
          for (let k = 0; k * width < ofRows.length; k++) {
            heights.set(ofRows.subarray(k * width, (k + 1) * width), to + k * nCols);
            valid.set(validOfRows.subarray(k * width, (k + 1) * width), to + k * nCols);
          }
        });
      }
    };
    await Promise.all(Array.from({ length: Math.min(read.nAtOnce, parts.length) }, work));
    return { heights, valid, level: found, ...place };
  }

  /** Return the part of a window that lies in the level. */
  #cut(level, window) {
    const shape = this.shape(level);
    const { row = 0, col = 0 } = window;
    const { nRows = shape.nRows - row, nCols = shape.nCols - col } = window;
    const cut = (first, n, end) => [Math.max(first, 0), Math.min(first + n, end) - Math.max(first, 0)];
    const [[top, height], [left, width]] = [cut(row, nRows, shape.nRows), cut(col, nCols, shape.nCols)];
    const isRight = [row, col, nRows, nCols].every(Number.isInteger) && height > 0 && width > 0;
    if (!isRight) {
      throw new ArgumentError(
        `window of ${nRows} x ${nCols} samples from row ${row}, column ${col} on: the level has` +
          ` ${shape.nRows} x ${shape.nCols} samples, rows and columns from 0 on`,
      );
    }
    return { row: top, col: left, nRows: height, nCols: width };
  }

  /** Return what reads parts of a window, `side` samples each and `nAtOnce` at once: workers, or we. */
  async #reader(level, { row, col, nRows, nCols }) {
    const { engine, fetch, fewestSamples } = this.#given;
    const unit = 2 * this.blockSize;
    const nUnits = (first, n) => Math.floor((first + n - 1) / unit) - Math.floor(first / unit) + 1;
    const n = nUnits(row, nRows) * nUnits(col, nCols);
    let side = Math.max(unit, SIDE);
    const isSmall = n < FEWEST_UNITS_FOR_WORKERS || (!this.#pool && nRows * nCols < fewestSamples);
    const pool = isSmall ? null : await this.#workers();
    if (!pool) {
      const read = (place, _, take) => engine.ask("read", place, fetch, take);
      if (nRows * nCols <= MOST_AT_ONCE) side = Infinity;
      return Object.assign(read, { side, nAtOnce: PARTS_AT_ONCE });
    }
    // Four units follow from one above them.
    while (side > 2 * unit && n * unit ** 2 < side ** 2 * pool.size) side /= 2;
    const near = Math.floor(row / side) + Math.floor(col / side);
    const read = async (place, i, take) => {
      try {
        const { heights, valid } = await pool.read({ ...place, dtype: this.dtype }, near + i);
        take(heights, valid, 0);
      } finally {
        if (pool.isBroken) this.#drop(pool); // another read starts new ones
      }
    };
    return Object.assign(read, { side, nAtOnce: PARTS_AT_ONCE * pool.size });
  }

  /** Return the workers, started when they are first needed; null: read here. */
  #workers() {
    const { file, fetch, nWorkers, signal } = this.#given;
    if (nWorkers === 0) return null;
    const own = { ...file, cacheBytes: Math.floor(file.cacheBytes / nWorkers) };
    this.#pool ??= WorkerPool.start(nWorkers, own, fetch).catch((error) => {
      if (signal?.aborted) return null;
      console.warn(`terrainwave: no workers, so the caller's thread decodes: ${error.message}`);
      return null;
    });
    return this.#pool;
  }

  async #drop(pool) {
    pool.close();
    if ((await this.#pool) === pool) this.#pool = null;
  }

  /** End workers, if there are any; nothing can be read any more. */
  async close() {
    this.#isClosed = true;
    (await this.#pool)?.close();
    await this.#given.engine.close();
  }

  /**
   * Return the physical height (raw · scale + offset) at world coordinates, by bilinear
   * interpolation between samples of a level; NaN outside them and where a void sample counts.
   */
  async sample(x, y, { level = -1, voids } = {}) {
    const found = this.#level(level);
    const [a, b, c, d, e, f] = this.transform(found);
    const determinant = a * e - b * d;
    // Of sample (0, 0) the pixel's centre is half a pixel away from its corner.
    const col = (e * (x - c) - b * (y - f)) / determinant - 0.5;
    const row = (a * (y - f) - d * (x - c)) / determinant - 0.5;
    const { nRows, nCols } = this.shape(found);
    if (!(row >= 0 && col >= 0 && row <= nRows - 1 && col <= nCols - 1)) return NaN;
    const [top, left] = [Math.floor(row), Math.floor(col)];
    const size = { nRows: Math.min(2, nRows - top), nCols: Math.min(2, nCols - left) };
    const { heights, valid } =
      await this.read(found, { row: top, col: left, ...size }, { voids });
    let [sum, v] = [0, row - top];
    for (let i = 0; i < size.nRows; i++) {
      let u = col - left;
      for (let j = 0; j < size.nCols; j++) {
        const weight = (i ? v : 1 - v) * (j ? u : 1 - u);
        if (weight === 0) continue;
        if (!valid[i * size.nCols + j]) return NaN;
        sum += weight * heights[i * size.nCols + j];
      }
    }
    return sum * this.scale + this.offset;
  }

  /**
   * Return how far the original's samples below a block are, at most, from the bilinear surface of
   * the block's samples: in physical units, 0 for a block without valid samples.
   */
  async blockError(level, row, col) {
    if (this.#isClosed) throw new ArgumentError("the terrain is closed");
    const place = { level: this.#level(level), row, col, blockSize: this.blockSize };
    const { nRows, nCols } = this.blockShape(level);
    if (![row, col].every(Number.isInteger) || row < 0 || col < 0 || row >= nRows || col >= nCols) {
      throw new ArgumentError(`there is no block ${row}, ${col} on level ${level}`);
    }
    const { engine, fetch } = this.#given;
    return (await engine.ask("blockError", place, fetch)) * Math.abs(this.scale);
  }

  /** Return the root of the file's digests as it states it, which nothing is compared with; null without digests. */
  async statedRoot() {
    const { engine, fetch } = this.#given;
    return engine.ask("statedRoot", null, fetch);
  }

  /** Return the digest of a tile, { heights, valid, nRows, nCols }: 512 x 512 samples, fewer at the last ones. */
  async digest(tile) {
    const { engine, fetch } = this.#given;
    return engine.digested("digest", tile, fetch);
  }

  /** Return the root of all heights by the digests of all tiles, row by row, in one Uint8Array. */
  async rootOf(digests) {
    const { engine, fetch } = this.#given;
    return engine.digested("rootOf", digests, fetch);
  }

  /** Return { nRows, nCols } of the blocks of a level. */
  blockShape(level = -1) {
    const step = 2 ** (this.nLevels - 1 - this.#level(level));
    const [nRows, nCols] = [this.nRows, this.nCols].map((n) =>
      Math.max(1, Math.ceil(Math.ceil((n - 1) / step) / this.blockSize)),
    );
    return { nRows, nCols };
  }
}
