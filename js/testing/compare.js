/** node compare.js FILE.twz BAND ORIGINAL.tif …: what the site's page finds of each original, as JSON. */

import { openAsBlob } from "node:fs";

import { WORK } from "../site/compare-worker.js";
import { prove } from "../site/prove.js";

/** As browsers have it: geotiff.js reads Blobs by it. */
globalThis.FileReader = class {
  async readAsArrayBuffer(blob) {
    this.result = await blob.arrayBuffer();
    this.onload({ target: this });
  }
};

const [path, band, ...originals] = process.argv.slice(2);
const twz = await openAsBlob(path);
const here = { ask: (what, question) => WORK[what](question), end: () => {} };
const found = [];
for (const original of originals) {
  const tif = Object.assign(await openAsBlob(original), { name: original });
  const { signal } = new AbortController();
  found.push(await prove({ twz, tif, band: Number(band) }, () => {}, signal, () => here)
    .catch(({ message }) => ({ error: message })));
}
console.log(JSON.stringify(found));
