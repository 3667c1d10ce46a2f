/**
 * Reads windows in a thread of its own. Questions { id, what, question } are answered { id, found } or
 * { id, error }; meanwhile { id, of, ranges } asks for bytes, for the question `of`, and gets the same.
 */

import { ARRAYS } from "./core.js";
import { Engine } from "./engine.js";
import { Mailbox } from "./mailbox.js";

/** Of Node, whose workers have no global messages; the name is no literal: bundlers would look. */
const THREADS = "node:worker_threads";

function work(post) {
  const mailbox = new Mailbox(({ name, message }) => Object.assign(new Error(message), { name }));
  let engine = null;

  /** Ask for bytes, for a question. */
  const fetchFor = (of) => (ranges) => {
    const { id, answer } = mailbox.ask(null);
    post({ id, of, ranges }, []);
    return answer;
  };
  const WORK = {
    async open(file, fetch) {
      engine = new Engine(file);
      await engine.describe(fetch);
    },
    async read(place, fetch) {
      const n = place.nRows * place.nCols;
      const [heights, valid] = [new ARRAYS[place.dtype](n), new Uint8Array(n)];
      await engine.read(place, fetch, (ofRows, validOfRows, row) => {
        heights.set(ofRows, row * place.nCols);
        valid.set(validOfRows, row * place.nCols);
      });
      return { heights, valid };
    },
  };

  return async ({ id, what, question, ...answer }) => {
    if (!what) {
      mailbox.settle({ id, ...answer });
      return;
    }
    try {
      const found = await WORK[what](question, fetchFor(id));
      post({ id, found }, found ? [found.heights.buffer, found.valid.buffer] : []);
    } catch (error) {
      post({ id, error: { name: error.name, message: error.message } }, []);
    }
  };
}

if (typeof globalThis.postMessage === "function") {
  const take = work((message, moved) => globalThis.postMessage(message, moved));
  globalThis.onmessage = ({ data }) => take(data);
} else {
  import(/* @vite-ignore */ /* webpackIgnore: true */ THREADS).then(({ parentPort }) => {
    parentPort.on("message", work((message, moved) => parentPort.postMessage(message, moved)));
  });
}
