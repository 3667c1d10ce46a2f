/**
 * Reads windows in a thread of its own. Questions { id, what, question } are answered { id, found } or
 * { id, error }; meanwhile { id, of, ranges } asks for bytes, for the question `of`, and gets the same.
 */

import { ARRAYS } from "./core.js";
import { Engine } from "./engine.js";
import { Mailbox, answer } from "./mailbox.js";

/** Of Node, whose workers have no global messages; the name is no literal: bundlers would look. */
const THREADS = "node:worker_threads";

function work(port) {
  const mailbox = new Mailbox(port);
  let engine = null;

  /** Ask for bytes, for a question. */
  const fetchFor = (of) => (ranges) => mailbox.ask({ of, ranges });
  const WORK = {
    async open(file, fetch) {
      engine = new Engine(file);
      await engine.describe(fetch);
    },
    async read(place, fetch) {
      const n = place.nRows * place.nCols;
      const [heights, valid] = [new ARRAYS[place.dtype](n), new Uint8Array(n)];
      await engine.ask("read", place, fetch, (ofRows, validOfRows, row) => {
        heights.set(ofRows, row * place.nCols);
        valid.set(validOfRows, row * place.nCols);
      });
      return { heights, valid };
    },
  };

  return ({ id, what, question, ...more }) =>
    what ? answer(port, id, () => WORK[what](question, fetchFor(id))) : mailbox.settle({ id, ...more });
}

if (typeof globalThis.postMessage === "function") {
  const take = work(globalThis);
  globalThis.onmessage = ({ data }) => take(data);
} else {
  import(/* @vite-ignore */ /* webpackIgnore: true */ THREADS).then(({ parentPort }) => {
    parentPort.on("message", work(parentPort));
  });
}
