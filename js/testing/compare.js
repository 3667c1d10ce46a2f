/** node compare.js FILE.twz BAND ORIGINAL.tif …: what the site's page finds of each original, as JSON. */

import { openAsBlob } from "node:fs";

import { Comparison } from "../site/compare.js";
import { Original } from "../site/original.js";
import { open } from "../src/index.js";

/** As browsers have it: geotiff.js reads Blobs by it. */
globalThis.FileReader = class {
  async readAsArrayBuffer(blob) {
    this.result = await blob.arrayBuffer();
    this.onload({ target: this });
  }
};

async function compared(terrain, path, band) {
  const original = await Original.open(Object.assign(await openAsBlob(path), { name: path }), band);
  const { isFatal, lines } = original.problems(terrain);
  if (isFatal) return { problems: lines };
  // Two halves, whose sums are added: workers do no more.
  const [sum, half] = [new Comparison(terrain, original.nodata), Math.ceil(terrain.nRows / 2)];
  for (const [row, nRows] of [[half, terrain.nRows - half], [0, half]]) {
    if (nRows === 0) continue;
    const window = { row, col: 0, nRows, nCols: terrain.nCols };
    const [source, decoded] = [await original.read(window), await terrain.read(-1, window)];
    const comparison = new Comparison(terrain, original.nodata);
    comparison.add(window, source.heights, source.valid, decoded.heights, decoded.valid);
    sum.merge(comparison.found);
  }
  const report = sum.report();
  return { ...report, problems: [...lines, ...report.problems] };
}

const [path, band, ...originals] = process.argv.slice(2);
const terrain = await open(await openAsBlob(path));
const found = [];
for (const original of originals) {
  found.push(await compared(terrain, original, Number(band)).catch(({ message }) => ({ error: message })));
}
console.log(JSON.stringify(found));
