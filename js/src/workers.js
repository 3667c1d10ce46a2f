/** Workers that decode units: those of browsers, or threads of Node. */

import * as errors from "./errors.js";
import { Mailbox } from "./mailbox.js";

const { ArgumentError, TerrainwaveError } = errors;
/** By default, on pages alone, where decoding would hold up the page. */
const MOST_BY_DEFAULT = 4;
const THREADS = "node:worker_threads"; // no literal: bundlers would look for it

/** Return how many workers to use, of the option `workers`. */
export function numberOfWorkers(asked) {
  if (asked === undefined) {
    const isPage = typeof document !== "undefined" && typeof Worker === "function";
    return isPage ? Math.min((navigator.hardwareConcurrency ?? 2) - 1, MOST_BY_DEFAULT) : 0;
  }
  if (!Number.isInteger(asked) || asked < 0 || asked > 64) {
    throw new ArgumentError(`workers: ${asked} is no number from 0 to 64`);
  }
  return asked;
}

/** Return a function that starts a worker: { post, end, hold }, which calls what it is given. */
async function starter(url) {
  if (typeof Worker === "function") {
    return (onMessage, onFailure) => {
      // In these words bundlers find the module.
      const worker = url ? new Worker(url, { type: "module" })
        : new Worker(new URL("./unit-worker.js", import.meta.url), { type: "module" });
      worker.onmessage = ({ data }) => onMessage(data);
      worker.onerror = (event) => {
        event.preventDefault();
        onFailure(event.message ?? "its module cannot be loaded");
      };
      return {
        post: (message, moved) => worker.postMessage(message, moved), end: () => worker.terminate(),
        hold: () => {},
      };
    };
  }
  const threads = await import(/* @vite-ignore */ THREADS);
  return (onMessage, onFailure) => {
    const worker = new threads.Worker(url ?? new URL("./unit-worker.js", import.meta.url));
    worker.on("message", onMessage);
    worker.on("error", (error) => onFailure(error.message));
    worker.on("exit", () => onFailure("it ended"));
    return {
      post: (message, moved) => worker.postMessage(message, moved), end: () => worker.terminate(),
      // A process that waits for nothing else ends, whatever idle workers there are.
      hold: (isBusy) => (isBusy ? worker.ref() : worker.unref()),
    };
  };
}

/** Return the error of a worker as one of ours. */
function errorOf({ name, message }) {
  const Kind = name in errors && errors[name].prototype instanceof TerrainwaveError
    ? errors[name] : TerrainwaveError;
  return new Kind(Kind === TerrainwaveError ? `a worker failed: ${message}` : message);
}

/** Gives each task to the first worker that has none. */
export class WorkerPool {
  #workers = [];
  #idle = [];
  #waiting = [];
  #mailbox = new Mailbox(errorOf);
  #failure = null;

  /** Start workers, which all get the message `first`; `url`: of another module (for tests). */
  static async start(n, first, url = null) {
    const pool = new WorkerPool();
    try {
      const begin = await starter(url);
      for (let i = 0; i < n; i++) {
        const worker = begin((data) => pool.#settle(data), (message) => pool.#fail(message));
        pool.#workers.push(worker);
      }
      await Promise.all(pool.#workers.map((worker) => pool.#give(worker, { ...first })));
    } catch (error) {
      pool.close();
      throw error instanceof TerrainwaveError ? error : errorOf(error);
    }
    return pool;
  }

  /** Whether one of them failed, so that none is asked any more. */
  get isBroken() {
    return this.#failure !== null;
  }

  /** Return the answer to { message, moved } of `make`, called when a worker is free. */
  ask(make) {
    return new Promise((resolve, reject) => {
      this.#waiting.push({ make, resolve, reject });
      this.#begin();
    });
  }

  /** End the workers; what is asked for is refused. */
  close() {
    this.#fail("it was closed");
    for (const worker of this.#workers.splice(0)) worker.end();
  }

  #give(worker, message, moved = []) {
    const { id, answer } = this.#mailbox.ask(worker);
    worker.hold(true);
    if (this.#failure) this.#settle({ id, error: this.#failure });
    else worker.post({ ...message, id }, moved);
    return answer;
  }

  #begin() {
    while (this.#waiting.length && (this.#idle.length || this.#failure)) {
      const { make, resolve, reject } = this.#waiting.shift();
      if (this.#failure) {
        reject(errorOf(this.#failure));
        continue;
      }
      const { message, moved } = make();
      this.#give(this.#idle.pop(), message, moved).then(resolve, reject);
    }
  }

  #settle(message) {
    const worker = this.#mailbox.settle(message);
    if (!worker) return;
    worker.hold(false);
    this.#idle.push(worker);
    this.#begin();
  }

  /** All fail with one of them: what it was asked, nobody else was told. */
  #fail(message) {
    this.#failure ??= { name: "Error", message };
    for (const id of this.#mailbox.ids) this.#settle({ id, error: this.#failure });
    this.#begin();
  }
}
