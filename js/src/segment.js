/** Segments and their index pages (FORMAT.md §3). */

import { crc32, viewOf } from "./bytes.js";
import { require, requireKnown } from "./errors.js";
import { ROOT_KEY, half, nameOf } from "./grid.js";
import { inflateZlib } from "./inflate.js";

const DEPTH = 4;
const MOST_PAGE = 2 ** 15;

/** Return the level whose blocks head the children of the top segment (§3.1). */
function firstHeads(grid) {
  return grid.kMax < DEPTH ? grid.kMax : grid.kMax % DEPTH;
}

/** Return the head of the segment of a key; null: the top segment. */
export function headOfKey(grid, key) {
  const t = firstHeads(grid);
  if (key.level < t) return null;
  const up = (key.level - t) % DEPTH;
  const cut = 2 ** up;
  return { level: key.level - up, row: Math.floor(key.row / cut), col: Math.floor(key.col / cut) };
}

/** Return the head of the segment whose child a segment is; null: the top segment. */
export function parentOfHead(grid, head) {
  if (head.level < firstHeads(grid) + DEPTH) return null;
  const cut = 2 ** DEPTH;
  return {
    level: head.level - DEPTH, row: Math.floor(head.row / cut), col: Math.floor(head.col / cut),
  };
}

/** Return the keys, blocks and heads of the children of a segment, in order (§3.1). */
export function layoutOf(grid, head) {
  const keys = head === null ? [ROOT_KEY] : [];
  const nLevels = head === null ? firstHeads(grid) : DEPTH;
  let row = head === null ? [{ level: 0, row: 0, col: 0 }] : [head];
  for (let i = 0; i < nLevels; i++) {
    keys.push(...row);
    row = row.flatMap((block) => grid.children(block));
  }
  const heads = row[0].level < grid.kMax ? row : [];
  return { keys, blocks: keys.flatMap((key) => grid.blocksOfKey(key)), heads };
}

/** Return the indices of a segment's keys in the order of their payloads in the file (§3.2). */
export function fileOrder(keys) {
  const levels = [[], [], [], []];
  keys.forEach((key, i) => levels[key.level - keys[0].level].push(i));
  const [order, second, third, fourth] = levels;
  for (const upper of second) {
    order.push(upper);
    for (const i of third) {
      const { row, col } = keys[i];
      if (half(row) === keys[upper].row && half(col) === keys[upper].col) order.push(i);
    }
  }
  return order.concat(fourth.reverse());
}

/** Return the number in 8 bytes, or Infinity where it is 2^53 or more: beyond every file here. */
function uint64(low, high) {
  return high < 2 ** 21 ? high * 2 ** 32 + low : Infinity;
}

class Columns {
  constructor(content) {
    this.content = content;
    this.at = 0;
  }

  /** Read a column of numbers below 2^32, stored in planes. */
  take(n, width) {
    const column = new Float64Array(n);
    for (let plane = 0, unit = 1; plane < width; plane++, unit *= 256) {
      for (let i = 0; i < n; i++) column[i] += unit * this.content[this.at++];
    }
    return column;
  }
}

/** Read a page (§3.3): { firstChild, … columns }. */
function readPage(page, { keys, blocks, heads }) {
  require(page.length >= 13, "a page is too short");
  const view = viewOf(page);
  require(crc32(page.subarray(4)) === view.getUint32(0, true), "checksum of a page");
  const [nKeys, nBlocks, nHeads] = [keys.length, blocks.length, heads.length];
  const size = 17 * nKeys + 4 * nBlocks + 12 * nHeads;
  const content = inflateZlib(page.subarray(12), size);
  require(content.length === size, "columns of a page have another size");
  const columns = new Columns(content);
  const payloadLength = columns.take(nKeys, 4);
  const meshLength = columns.take(nKeys, 4);
  requireKnown(columns.take(nKeys, 1).every((flags) => flags === 0), "flags of a key");
  const zMin = columns.take(nBlocks, 1);
  const zMax = columns.take(nBlocks, 1);
  const error = columns.take(nBlocks, 1);
  columns.take(nBlocks, 1); // mesh_error
  const childPageLength = columns.take(nHeads, 4);
  const low = columns.take(nHeads, 4);
  const high = columns.take(nHeads, 4);
  return {
    firstChild: uint64(view.getUint32(4, true), view.getUint32(8, true)),
    payloadLength, meshLength, zMin, zMax, error, childPageLength,
    childLength: low.map((number, i) => uint64(number, high[i])),
    payloadCrc: columns.take(nKeys, 4),
    meshCrc: columns.take(nKeys, 4),
  };
}

/**
 * What a page says: places of payloads by key, codes by block, places of child segments by head.
 *
 * `place` of a segment is { start, pageLength, end, siblingsEnd }; null: it is absent (§3.4).
 */
export class Segment {
  constructor(grid, head, place, page, fileSize) {
    const layout = layoutOf(grid, head);
    this.payloads = new Map();
    this.errors = new Map();
    this.children = new Map();
    if (place === null) {
      for (const key of layout.keys) this.payloads.set(nameOf(key), EMPTY);
      for (const block of layout.blocks) this.errors.set(nameOf(block), 0);
      for (const child of layout.heads) this.children.set(nameOf(child), null);
      return;
    }
    const columns = readPage(page, layout);
    const end = this.placePayloads(layout.keys, columns, place.start + page.length);
    const hasChildren = layout.heads.length > 0;
    require(columns.firstChild > 0 === hasChildren, "first_child");
    // The top segment's length follows from what comes after it (§3.5).
    const isTop = head === null;
    const stated = isTop ? (hasChildren ? columns.firstChild : fileSize) : place.end;
    require(end === stated && end <= fileSize, "length of a segment");
    require(!hasChildren || columns.firstChild >= place.siblingsEnd, "first_child");
    layout.blocks.forEach((block, i) => this.errors.set(nameOf(block), columns.error[i]));
    this.placeChildren(grid, layout.heads, columns, fileSize, isTop);
  }

  /** Return where the last payload or mesh ends. */
  placePayloads(keys, { payloadLength, meshLength, payloadCrc, meshCrc }, start) {
    let at = start;
    for (const i of fileOrder(keys)) {
      const lengths = [payloadLength[i], meshLength[i]];
      require(lengths.every((n) => n < 2 ** 31), "length of a payload or a mesh");
      require(lengths[0] > 0 || payloadCrc[i] === 0, "checksum of an empty payload");
      require(lengths[1] > 0 || meshCrc[i] === 0, "checksum of an empty mesh");
      this.payloads.set(nameOf(keys[i]), { start: at, end: at + lengths[0], crc: payloadCrc[i] });
      at += lengths[0] + lengths[1];
    }
    return at;
  }

  placeChildren(grid, heads, { firstChild, childPageLength, childLength }, fileSize, isTop) {
    let at = firstChild;
    const places = heads.map((_, i) => {
      const [pageLength, length] = [childPageLength[i], childLength[i]];
      require((pageLength === 0) === (length === 0), "child_length");
      if (length === 0) return null;
      require(pageLength >= 13 && pageLength <= MOST_PAGE, "child_page_length");
      require(length >= pageLength && length <= fileSize, "child_length");
      at += length;
      return { start: at - length, pageLength, end: at, siblingsEnd: 0 };
    });
    require(heads.length === 0 || at <= fileSize, "child segments end beyond the file");
    const areLast = isTop && heads.length > 0 && heads[0].level + DEPTH >= grid.kMax;
    require(!areLast || at === fileSize, "bytes after the last segment");
    heads.forEach((head, i) => {
      if (places[i]) places[i].siblingsEnd = at;
      this.children.set(nameOf(head), places[i]);
    });
  }
}

const EMPTY = { start: 0, end: 0, crc: 0 };
