/** Parts of the format that tests know, to make files out of parts of others: FORMAT.md §1.3, §3, §4.1. */

/** Return the lengths of metadata, parameters and top page that a header states. */
export function lengthsOf(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  return [76, 108, 116].map((at) => view.getUint32(at, true));
}

/** Return the keys of a file of one segment, in the order of its columns (§3.1). */
export function keysOf(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const shape = [24, 28].map((at) => view.getUint32(at, true));
  const nCells = 2 ** bytes[32];
  let kMax = 0;
  while (Math.ceil((Math.max(...shape) - 1) / 2 ** kMax) > nCells) kMax++;
  if (kMax >= 4) throw new Error("more than one segment");
  const keys = [{ level: -1, row: 0, col: 0 }];
  let blocks = [{ level: 0, row: 0, col: 0 }];
  for (let level = 0; level < kMax; level++) {
    keys.push(...blocks);
    const [nRows, nCols] = shape.map((n) => Math.max(1, Math.ceil(Math.ceil((n - 1) / 2 ** (kMax - level - 1)) / nCells)));
    blocks = blocks.flatMap(({ row, col }) => [[0, 0], [0, 1], [1, 0], [1, 1]].map(([down, right]) =>
      ({ level: level + 1, row: 2 * row + down, col: 2 * col + right }),
    )).filter(({ row, col }) => row < nRows && col < nCols);
  }
  return keys;
}

/** Return the indices of keys in the order of their payloads in the file (§3.2). */
export function fileOrder(keys) {
  const levels = [[], [], [], []];
  keys.forEach((key, i) => levels[key.level - keys[0].level].push(i));
  const [order, second, third, fourth] = levels;
  for (const upper of second) {
    order.push(upper);
    for (const i of third) {
      const { row, col } = keys[i];
      if (row >> 1 === keys[upper].row && col >> 1 === keys[upper].col) order.push(i);
    }
  }
  return order.concat(fourth.reverse());
}
