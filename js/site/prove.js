/** Proof of a file by its original: workers compare bands of rows, and their sums are added. */

import { mailboxOf } from "../src/mailbox.js";
import { Comparison } from "./compare.js";

const MOST_WORKERS = 4;
/** Decoded units that all workers keep, bytes. */
const CACHE = 2 ** 27;
/** A GeoTIFF whose strips are larger than so many samples is read by one worker: each decodes whole strips. */
const MANY_SAMPLES = 2 ** 25;

function startWorker() {
  const worker = new Worker(new URL("./compare-worker.js", import.meta.url), { type: "module" });
  const mailbox = mailboxOf(worker);
  const end = (reason) => {
    worker.terminate();
    mailbox.fail(reason ?? new DOMException("ended", "AbortError"));
  };
  return { ask: (what, question) => mailbox.ask({ what, question }), end };
}

/**
 * Compare `twz`, a File or a URL, with `tif`, a File. `onProgress` is called with the share of samples compared.
 * Return the report of `Comparison`, with { root, stated } of the heights' digests. `start` returns a worker.
 */
export async function prove({ twz, tif, band }, onProgress, signal, start = startWorker) {
  const provers = [start()];
  const end = () => provers.forEach((prover) => prover.end(signal.reason));
  signal.addEventListener("abort", end);
  try {
    const n = Math.min(Math.max(globalThis.navigator?.hardwareConcurrency ?? 2, 1), MOST_WORKERS);
    const question = { twz, tif, band, cacheBytes: Math.floor(CACHE / n) };
    const { file, nRows, nCols, rows, nodata, isFatal, lines, stated } = await provers[0].ask("open", question);
    if (isFatal) throw new Error(lines[0]);
    const nWorkers = rows * nCols > MANY_SAMPLES ? 1 : Math.min(n, Math.ceil(nRows / rows));
    while (provers.length < nWorkers) provers.push(start());
    await Promise.all(provers.slice(1).map((prover) => prover.ask("open", question)));

    const comparison = new Comparison(file, nodata);
    const parts = new Array(Math.ceil(nRows / rows));
    let next = 0;
    await Promise.all(provers.map(async (prover) => {
      while (next < parts.length) {
        const i = next++;
        const { found, digests } = await prover.ask("band", { row: i * rows, nRows: Math.min(rows, nRows - i * rows) });
        comparison.merge(found);
        parts[i] = digests;
        onProgress(comparison.found.nSamples / (nRows * nCols));
      }
    }));
    const root = await provers[0].ask("root", new Uint8Array(await new Blob(parts).arrayBuffer()));
    const report = comparison.report();
    const isOther = stated !== null && stated !== root;
    const problems = [...lines, ...report.problems, ...(isOther ? ["the decoded heights have another root than the file states"] : [])];
    return { ...report, problems, root, stated };
  } finally {
    signal.removeEventListener("abort", end);
    provers.forEach((prover) => prover.end());
  }
}
