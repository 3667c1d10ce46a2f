/** Workers that read windows of one file: those of browsers, or threads of Node. */

import * as errors from "./errors.js";
import { Mailbox } from "./mailbox.js";

const { ArgumentError, TerrainwaveError } = errors;
/** By default, on pages alone, where decoding would hold up the page. */
const MOST_BY_DEFAULT = 4;

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
        : new Worker(new URL("./read-worker.js", import.meta.url), { type: "module" });
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
  const { startThread } = await import("#threads");
  return (onMessage, onFailure) => {
    const worker = startThread(url);
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
function errorOf(error) {
  if (error instanceof Error) return error;
  const Kind = errors[error.name]?.prototype instanceof TerrainwaveError
    ? errors[error.name] : TerrainwaveError;
  return new Kind(Kind === TerrainwaveError ? `a worker failed: ${error.message}` : error.message);
}

export class WorkerPool {
  #workers = []; // { worker, n }: n questions wait
  #mailbox = new Mailbox(errorOf);
  #fetch;
  #failures = new Map(); // by question: why its bytes did not come
  #failure = null;

  /**
   * Start workers of a file, for an `Engine` each, and `fetch` what they need; `url`: of another module (for tests).
   */
  static async start(n, file, fetch, url = null) {
    const pool = new WorkerPool();
    pool.#fetch = fetch;
    try {
      const begin = await starter(url);
      for (let i = 0; i < n; i++) {
        const one = { n: 0 };
        const take = (data) => (data.ranges ? pool.#serve(one, data) : pool.#settle(data));
        one.worker = begin(take, (message) => pool.#fail(message));
        pool.#workers.push(one);
      }
      await Promise.all(pool.#workers.map((one) => pool.#give(one, "open", file)));
    } catch (error) {
      pool.close();
      throw errorOf(error);
    }
    return pool;
  }

  /** True after one of them failed: none is asked any more. */
  get isBroken() {
    return this.#failure !== null;
  }

  get size() {
    return this.#workers.length;
  }

  /** Return { heights, valid } of a window: by who has least to do, else by who may have read it. */
  read(place, number) {
    const order = this.#workers.map((_, i) => this.#workers[(i + number) % this.#workers.length]);
    if (order.length === 0) return Promise.reject(errorOf(this.#failure));
    return this.#give(order.reduce((best, one) => (one.n < best.n ? one : best)), "read", place);
  }

  /** End the workers; what is asked for is refused. */
  close() {
    this.#fail("it was closed");
    for (const { worker } of this.#workers.splice(0)) worker.end();
  }

  #give(one, what, question) {
    const { id, answer } = this.#mailbox.ask(one);
    one.n++;
    one.worker.hold(true);
    if (this.#failure) this.#settle({ id, error: this.#failure });
    else one.worker.post({ id, what, question }, []);
    return answer;
  }

  /** Bring the bytes that a worker needs for its question `of`. */
  async #serve({ worker }, { id, of, ranges }) {
    try {
      // Copies: of parts, the whole would go to the worker.
      const parts = (await this.#fetch(ranges)).map((bytes) => new Uint8Array(bytes));
      worker.post({ id, found: parts }, parts.map(({ buffer }) => buffer));
    } catch (error) {
      this.#failures.set(of, error);
      worker.post({ id, error: { name: error.name, message: error.message } }, []);
    }
  }

  #settle({ id, found, error }) {
    const reason = error && (this.#failures.get(id) ?? error);
    this.#failures.delete(id);
    const one = this.#mailbox.settle({ id, found, error: reason });
    if (!one) return;
    one.n--;
    one.worker.hold(one.n > 0);
  }

  /** All fail with one of them: what it was asked, nobody else was told. */
  #fail(message) {
    this.#failure ??= { name: "Error", message };
    for (const id of this.#mailbox.ids) this.#settle({ id, error: this.#failure });
  }
}
