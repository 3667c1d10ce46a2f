/** Levels, blocks, keys and units (FORMAT.md §2). */

/** Sample and block numbers may need 32 bits: no signed shifts here. */
export const half = (i) => Math.floor(i / 2);

export const nameOf = ({ level, row, col }) => `${level}/${row}/${col}`;

export class Grid {
  constructor(header) {
    this.nRows = header.nRows;
    this.nCols = header.nCols;
    this.nCells = 2 ** header.blockLog2;
    this.rings = (header.borderRings - 1) / 2;
    this.kMax = 0;
    const most = Math.max(this.nRows, this.nCols) - 1;
    while (Math.ceil(most / 2 ** this.kMax) > this.nCells) this.kMax++;
  }

  /** Return [rows, columns] of a level (§2.1). */
  samples(level) {
    const step = 2 ** (this.kMax - level);
    return [this.nRows, this.nCols].map((n) => Math.floor((n - 1) / step) + 1);
  }

  /** Return [rows, columns] of the blocks of a level (§2.2). */
  nBlocks(level) {
    const step = 2 ** (this.kMax - level);
    return [this.nRows, this.nCols].map((n) =>
      Math.max(1, Math.ceil(Math.ceil((n - 1) / step) / this.nCells)),
    );
  }

  hasBlock({ level, row, col }) {
    if (!(Number.isInteger(level) && level >= 0 && level <= this.kMax)) return false;
    const [nRows, nCols] = this.nBlocks(level);
    return Number.isInteger(row) && row >= 0 && row < nRows &&
      Number.isInteger(col) && col >= 0 && col < nCols;
  }

  /** Return the children of a block, in Morton order. */
  children({ level, row, col }) {
    const [nRows, nCols] = this.nBlocks(level + 1);
    const found = [];
    for (let i = 0; i < 4; i++) {
      const child = { level: level + 1, row: 2 * row + (i >> 1), col: 2 * col + (i & 1) };
      if (child.row < nRows && child.col < nCols) found.push(child);
    }
    return found;
  }

  /** Return the blocks that the unit of a key consists of (§2.4). */
  blocksOfKey(key) {
    return key.level < 0 ? [{ level: 0, row: 0, col: 0 }] : this.children(key);
  }

  /** Return the key of the unit that holds a block. */
  keyOfBlock({ level, row, col }) {
    return level === 0 ? ROOT_KEY : { level: level - 1, row: half(row), col: half(col) };
  }

  /**
   * Return the unit of a key (§2.4): { key, level, rows, cols }.
   *
   * Of each axis: coreFirst, nCore, first, last and n of the region, core (the core's first line in
   * the region), isShared of the sides before and after.
   */
  unit(key) {
    const level = key.level + 1;
    const nSides = key.level < 0 ? 1 : 2;
    const samples = this.samples(level);
    const blocks = this.nBlocks(level);
    const [rows, cols] = [key.row, key.col].map((i, axis) => {
      const coreFirst = nSides * i * this.nCells;
      const coreLast = Math.min(nSides * (i + 1) * this.nCells, samples[axis] - 1);
      const first = Math.max(coreFirst - this.rings, 0);
      const last = Math.min(coreLast + this.rings, samples[axis] - 1);
      return {
        coreFirst, nCore: coreLast - coreFirst + 1, first, last, n: last - first + 1,
        core: coreFirst - first, isShared: [i > 0, nSides * (i + 1) < blocks[axis]],
      };
    });
    return { key, level, rows, cols };
  }

  /** Return where the parent heights of a group lie: its block, with the apron (§2.4). */
  parentPlace(key) {
    const samples = this.samples(key.level);
    const [rows, cols] = [key.row, key.col].map((i, axis) => {
      const first = Math.max(i * this.nCells - this.rings, 0);
      const last = Math.min((i + 1) * this.nCells + this.rings, samples[axis] - 1);
      return { first, last, n: last - first + 1 };
    });
    return { rows, cols };
  }
}

export const ROOT_KEY = { level: -1, row: 0, col: 0 };
