/** Decodes units in a thread of its own: messages { id, … } are answered by id. */

import { Grid } from "./grid.js";
import { readHeader } from "./header.js";
import { loadKernels } from "./kernels.js";
import { METHODS } from "./methods.js";
import { decodePayload } from "./payload.js";

/** Of Node, whose workers have no global messages; the name is no literal: bundlers would look. */
const THREADS = "node:worker_threads";
const port = typeof globalThis.postMessage === "function"
  ? globalThis : (await import(/* @vite-ignore */ THREADS)).parentPort;

let file = null;

const WORK = {
  /** `start` is the header of a file, `parameters` its tables. */
  async open({ start, fileSize, parameters, quantaOfNodata }) {
    await loadKernels();
    const header = readHeader(start, fileSize);
    const { prepare, decode } = METHODS[header.method];
    file = {
      header, grid: new Grid(header), quantaOfNodata, decodeMethod: decode,
      tables: prepare(parameters, header),
    };
    return {};
  },
  decode({ key, payload, parent }) {
    const { heights, valid, hasVoid, remainders, own } =
      decodePayload(file, file.grid.unit(key), payload, parent);
    return { heights, valid, hasVoid, remainders, own };
  },
};

async function answer({ data }) {
  const { id, what, ...message } = data;
  try {
    const found = await WORK[what](message);
    const { heights, valid, remainders, own } = found;
    const arrays = [heights, valid, remainders?.low, remainders?.high, own];
    port.postMessage({ id, found }, arrays.filter(Boolean).map(({ buffer }) => buffer));
  } catch (error) {
    port.postMessage({ id, error: { name: error.name, message: error.message } });
  }
}

if (port === globalThis) port.onmessage = answer;
else port.on("message", (data) => answer({ data }));
