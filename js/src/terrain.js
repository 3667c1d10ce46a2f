/** A terrain: what users hold. */

import { BlockSource } from "./blocks.js";
import { Container } from "./container.js";
import { ArgumentError, LimitExceededError } from "./errors.js";
import { half, nameOf } from "./grid.js";
import { HAS_FILLS, requireMethod } from "./header.js";
import { loadKernels } from "./kernels.js";
import { METHODS } from "./methods.js";
import { decodePayload } from "./payload.js";
import { Heights } from "./quanta.js";
import { openSource } from "./source.js";
import { WorkerPool, numberOfWorkers } from "./workers.js";

const DEFAULTS = { cacheBytes: 2 ** 27, maxSamples: 2 ** 28 };
/** Payloads are fetched for so many units at a time. */
const UNITS_AT_ONCE = 64;
/** Fewer units are decoded at once: workers take their time to start. */
const FEWEST_FOR_WORKERS = 3;

/** Decoded units by key, the least recently used one dropped first. */
class Cache {
  constructor(nBytes) {
    this.left = nBytes;
    this.units = new Map();
  }

  static bytesOf({ heights, remainders, own }) {
    return heights.length * (5 + (remainders ? 8 : 0) + (own ? 1 : 0));
  }

  get(name) {
    const unit = this.units.get(name);
    if (unit) {
      this.units.delete(name);
      this.units.set(name, unit);
    }
    return unit;
  }

  put(name, unit) {
    if (this.units.has(name)) return;
    this.units.set(name, unit);
    this.left -= Cache.bytesOf(unit);
    for (const [oldest, held] of this.units) {
      if (this.left >= 0 || this.units.size === 1) break;
      this.units.delete(oldest);
      this.left += Cache.bytesOf(held);
    }
  }
}

/** Open a .twz file: a URL, a File or Blob, bytes, or an object { size, read(start, end) }. */
export async function open(from, options = {}) {
  const found = openSource(from, options);
  const source = options.blocks ? new BlockSource(found) : found;
  const [container] = await Promise.all([Container.open(source), loadKernels()]);
  requireMethod(container.header, METHODS);
  return new Terrain(container, { ...DEFAULTS, ...options });
}

/** Return parent heights in arrays of their own. */
function cutOut({ rows, cols, heights, valid, hasVoid, own, base, stride }) {
  const part = {
    rows, cols, hasVoid, base: 0, stride: cols.n,
    heights: new Int32Array(rows.n * cols.n), valid: new Uint8Array(rows.n * cols.n),
    own: own && new Uint8Array(rows.n * cols.n),
  };
  for (let row = 0; row < rows.n; row++) {
    const from = base + row * stride;
    part.heights.set(heights.subarray(from, from + cols.n), row * cols.n);
    part.valid.set(valid.subarray(from, from + cols.n), row * cols.n);
    if (own) part.own.set(own.subarray(from, from + cols.n), row * cols.n);
  }
  return part;
}

/** A multiresolution raster of heights. Level 0 is the coarsest, -1 the full grid. */
export class Terrain {
  #container;
  #file;
  #heights;
  #cache;
  #maxSamples;
  #nWorkers;
  #isAsked; // whether the caller named the number of workers
  #pool = null; // a promise of workers, or of null
  #pending = new Map(); // by name: promises of units that workers decode
  #isClosed = false;

  constructor(container, { cacheBytes, maxSamples, workers }) {
    const { header, metadata, grid } = container;
    const { prepare, decode } = METHODS[header.method];
    const heights = new Heights(header, metadata);
    this.#container = container;
    this.#heights = heights;
    this.#cache = new Cache(cacheBytes);
    this.#maxSamples = maxSamples;
    this.#nWorkers = numberOfWorkers(workers);
    this.#isAsked = workers !== undefined;
    this.#file = {
      header, grid, quantaOfNodata: heights.quantaOfNodata, decodeMethod: decode,
      tables: prepare(container.parameters, header),
    };
    this.nRows = header.nRows;
    this.nCols = header.nCols;
    this.nLevels = grid.kMax + 1;
    this.blockSize = grid.nCells;
    this.dtype = header.dtype.name;
    this.method = header.method;
    this.hasFills = (header.features & HAS_FILLS) !== 0;
    this.maxError = header.maxError * Math.abs(metadata.scale ?? 1);
    this.effectiveBound = header.effectiveBound * Math.abs(metadata.scale ?? 1);
    this.metadata = metadata;
    this.crs = metadata.crs ?? null;
    this.units = metadata.units ?? null;
    this.scale = metadata.scale ?? 1;
    this.offset = metadata.offset ?? 0;
    this.nodata = heights.nodata;
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

  #checkVoids(voids, level) {
    if (voids !== "exact" && voids !== "any") {
      throw new ArgumentError(`voids ${voids}: expected "exact" or "any"`);
    }
    const mayHide = level < this.nLevels - 1 && (this.metadata.mask_kind ?? "none") !== "none";
    if (voids === "exact" && mayHide && !this.hasFills) {
      throw new ArgumentError(
        "the file is of format 1.0, which does not tell which heights of coarse levels are fills: " +
          "read them with voids \"any\", or compress the raster again",
      );
    }
  }

  /** Return { nRows, nCols } of a level. */
  shape(level = -1) {
    const [nRows, nCols] = this.#file.grid.samples(this.#level(level));
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
   * `window` is { row, col, nRows, nCols } in samples of the level, by default all of it. Returns
   * { heights, valid, level, row, col, nRows, nCols }: heights in the file's dtype and validity, 1
   * or 0, row by row. Void samples hold `nodata`, or NaN, or 0 in an integer dtype without one.
   *
   * `voids` says which samples of a coarse level are void: "exact", where the full grid is, sample
   * by sample, or "any", those alone around which nothing is valid, while the others have a height
   * that is a fill. By default exact, if the file tells (`hasFills`), else any.
   */
  async read(level = -1, window = {}, { voids = this.hasFills ? "exact" : "any" } = {}) {
    if (this.#isClosed) throw new ArgumentError("the terrain is closed");
    const found = this.#level(level);
    this.#checkVoids(voids, found);
    const shape = this.shape(found);
    const { row = 0, col = 0 } = window ?? {};
    const { nRows = shape.nRows - row, nCols = shape.nCols - col } = window ?? {};
    const isRight = [row, col, nRows, nCols].every((n) => Number.isInteger(n) && n >= 0) &&
      nRows > 0 && nCols > 0 && row + nRows <= shape.nRows && col + nCols <= shape.nCols;
    if (!isRight) {
      throw new ArgumentError(
        `window ${row}, ${col}, ${nRows} x ${nCols} of ${shape.nRows} x ${shape.nCols} samples`,
      );
    }
    if (nRows * nCols > this.#maxSamples) {
      throw new LimitExceededError(
        `${nRows} x ${nCols} samples are more than maxSamples, ${this.#maxSamples}`,
      );
    }
    const { array } = this.#file.header.dtype;
    const heights = new array(nRows * nCols);
    const valid = new Uint8Array(nRows * nCols);
    const place = { row, col, nRows, nCols };
    const keys = this.#keysOf(found, place);
    for (let i = 0; i < keys.length; i += UNITS_AT_ONCE) {
      await this.#decode(keys.slice(i, i + UNITS_AT_ONCE), (unit) =>
        this.#copy(unit, place, voids, heights, valid),
      );
    }
    return { heights, valid, level: found, ...place };
  }

  /** Return the keys of the units whose cores meet a window, near ones near each other. */
  #keysOf(level, { row, col, nRows, nCols }) {
    const { grid } = this.#file;
    const [nBlockRows, nBlockCols] = grid.nBlocks(level);
    const range = (first, n, nBlocks) => {
      const block = (place) => Math.min(Math.floor(place / grid.nCells), nBlocks - 1);
      const cut = level === 0 ? 0 : 1;
      return [block(first), block(first + n - 1)].map((i) => Math.floor(i / 2 ** cut));
    };
    const [top, bottom] = range(row, nRows, nBlockRows);
    const [left, right] = range(col, nCols, nBlockCols);
    const keys = [];
    // In bands of 8 x 8: units below the same ancestors follow each other.
    for (let m = top - (top % 8); m <= bottom; m += 8) {
      for (let n = left - (left % 8); n <= right; n += 8) {
        for (let i = Math.max(m, top); i <= Math.min(m + 7, bottom); i++) {
          for (let j = Math.max(n, left); j <= Math.min(n + 7, right); j++) {
            keys.push({ level: level - 1, row: i, col: j });
          }
        }
      }
    }
    return keys;
  }

  /** Decode units and all they depend on, calling `use` for each of those asked for. */
  async #decode(keys, use) {
    const { grid } = this.#file;
    const wanted = new Map(); // by name: keys whose units must be decoded, ancestors first
    const add = (key) => {
      const name = nameOf(key);
      if (wanted.has(name) || this.#cache.get(name)) return;
      if (key.level >= 0) add(grid.keyOfBlock(key));
      wanted.set(name, key);
    };
    const held = new Map(); // what the cache might drop meanwhile
    const hold = (key) => {
      const name = nameOf(key);
      const unit = held.get(name) ?? this.#cache.get(name);
      if (unit) held.set(name, unit);
      return unit;
    };
    keys.forEach(add);
    for (const key of wanted.values()) if (key.level >= 0) hold(grid.keyOfBlock(key));
    keys.forEach(hold);
    const list = [...wanted.values()];
    const payloads = await this.#container.payloads(list);
    const asked = new Set(keys.map(nameOf));
    for (const unit of held.values()) {
      if (asked.has(nameOf(unit.unit.key))) use(unit);
    }
    const pool = list.length < FEWEST_FOR_WORKERS ? null : await this.#workers();
    const done = (name, key, unit) => {
      this.#cache.put(name, unit);
      if (key.level < grid.kMax - 1) held.set(name, unit);
      if (asked.has(name)) use(unit);
    };
    if (pool) {
      await this.#decodeByWorkers(pool, list, payloads, held, done);
      return;
    }
    list.forEach((key, i) => {
      const parent = key.level < 0 ? null : this.#parent(key, held.get(nameOf(grid.keyOfBlock(key))));
      const name = nameOf(key);
      // Another reader may have decoded it while the payloads were on their way.
      const unit = this.#cache.get(name) ??
        decodePayload(this.#file, grid.unit(key), payloads[i], parent);
      done(name, key, unit);
    });
  }

  /** Return the workers, started when they are first needed; null: decode here. */
  #workers() {
    if (this.#nWorkers === 0) return null;
    const { start, parameters, header } = this.#container;
    const first = {
      what: "open", start, fileSize: header.fileSize, parameters,
      quantaOfNodata: this.#file.quantaOfNodata,
    };
    this.#pool ??= WorkerPool.start(this.#nWorkers, first).catch((error) => {
      if (this.#isAsked) {
        this.#pool = null; // another read tries again
        throw error;
      }
      return null; // an engine without modules in workers, a page whose policy forbids them
    });
    return this.#pool;
  }

  /** Decode units in the order in which their ancestors are there. */
  async #decodeByWorkers(pool, list, payloads, held, done) {
    const { grid } = this.#file;
    const units = new Map();
    const decode = async (key, name, payload) => {
      const above = key.level < 0 ? null : nameOf(grid.keyOfBlock(key));
      if (above !== null) await units.get(above);
      // Another reader may have decoded it meanwhile, or be about to.
      let unit = this.#cache.get(name) ?? this.#pending.get(name);
      if (!unit) {
        const parent = above === null ? null : this.#parent(key, held.get(above));
        unit = this.#ask(pool, key, payload, parent);
        this.#pending.set(name, unit);
        const forget = () => this.#pending.delete(name);
        unit.then(forget, forget);
      }
      done(name, key, await unit);
    };
    list.forEach((key, i) => {
      const name = nameOf(key);
      units.set(name, decode(key, name, payloads[i]));
    });
    try {
      await Promise.all(units.values());
    } finally {
      if (pool.isBroken) {
        pool.close();
        if ((await this.#pool) === pool) this.#pool = null; // another read starts new ones
      }
    }
  }

  async #ask(pool, key, payload, parent) {
    const found = await pool.ask(() => {
      const own = payload.slice(); // or all bytes of its request would be copied
      const part = parent && cutOut(parent);
      const arrays = part ? [own, part.heights, part.valid, part.own] : [own];
      const moved = arrays.filter(Boolean).map(({ buffer }) => buffer);
      return { message: { what: "decode", key, payload: own, parent: part }, moved };
    });
    return { unit: this.#file.grid.unit(key), ...found };
  }

  /** End workers, if there are any; nothing can be read any more. */
  async close() {
    this.#isClosed = true;
    const pool = await this.#pool?.catch(() => null);
    pool?.close();
  }

  /** Return the parent heights of a group, as methods take them. */
  #parent(key, { unit, heights, valid, hasVoid, own }) {
    const { rows, cols } = this.#file.grid.parentPlace(key);
    const stride = unit.cols.n;
    const base = (rows.first - unit.rows.first) * stride + cols.first - unit.cols.first;
    return { rows, cols, heights, valid, hasVoid, own, base, stride };
  }

  /** Copy what lies both in a unit's core and in a window. */
  #copy(decoded, window, voids, heights, valid) {
    const isValid = voids === "any" ? decoded.valid : decoded.own ?? decoded.valid;
    const { rows, cols } = decoded.unit;
    const top = Math.max(rows.coreFirst, window.row);
    const bottom = Math.min(rows.coreFirst + rows.nCore, window.row + window.nRows);
    const left = Math.max(cols.coreFirst, window.col);
    const right = Math.min(cols.coreFirst + cols.nCore, window.col + window.nCols);
    if (left >= right) return;
    for (let row = top; row < bottom; row++) {
      const to = (row - window.row) * window.nCols + left - window.col;
      const from = (row - rows.first) * cols.n + left - cols.first;
      valid.set(isValid.subarray(from, from + right - left), to);
      this.#heights.write(heights, to, { ...decoded, valid: isValid }, from, right - left);
    }
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
    const block = { level: this.#level(level), row, col };
    if (!this.#file.grid.hasBlock(block)) {
      throw new ArgumentError(`there is no block ${row}, ${col} on level ${level}`);
    }
    const code = await this.#container.errorCode(block);
    const quanta = code ? Math.floor(((8 + (code % 8)) * 2 ** Math.floor(code / 8)) / 8) : 0;
    const { quantumNum, quantumDen } = this.#file.header;
    return ((quanta * Number(quantumNum)) / Number(quantumDen)) * Math.abs(this.scale);
  }

  /** Return { nRows, nCols } of the blocks of a level. */
  blockShape(level = -1) {
    const [nRows, nCols] = this.#file.grid.nBlocks(this.#level(level));
    return { nRows, nCols };
  }
}
