/** Workers that read windows of one file: those of browsers, or threads of Node. */

import * as errors from "./errors.js";
import { Mailbox, answer } from "./mailbox.js";

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

/** Return a function that starts a worker, which calls what it is given. */
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
      return worker;
    };
  }
  const { startThread } = await import("#threads");
  return (onMessage, onFailure) => {
    const worker = startThread(url);
    worker.on("message", onMessage);
    worker.on("error", (error) => onFailure(error.message));
    worker.on("exit", () => onFailure("it ended"));
    return worker;
  };
}

/** Return the error of a worker as one of ours. */
function errorOf(error) {
  const Kind = errors[error.name]?.prototype instanceof TerrainwaveError
    ? errors[error.name] : TerrainwaveError;
  return new Kind(Kind === TerrainwaveError ? `a worker failed: ${error.message}` : error.message);
}

export class WorkerPool {
  #workers = []; // { worker, mailbox, failures }: why bytes did not come, by question
  #fetch;
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
        const one = { failures: new Map() };
        const take = (data) => (data.ranges ? pool.#serve(one, data) : pool.#settle(one, data));
        one.worker = begin(take, (message) => pool.#fail(message));
        one.mailbox = new Mailbox(one.worker, errorOf);
        pool.#workers.push(one);
      }
      await Promise.all(pool.#workers.map((one) => pool.#ask(one, "open", file)));
    } catch (error) {
      pool.close();
      throw error;
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
  async read(place, number) {
    const order = this.#workers.map((_, i) => this.#workers[(i + number) % this.#workers.length]);
    if (order.length === 0) throw this.#failure;
    return this.#ask(order.reduce((best, one) => (one.mailbox.size < best.mailbox.size ? one : best)), "read", place);
  }

  /** End the workers; what is asked for is refused. */
  close() {
    this.#fail("it was closed");
    for (const { worker } of this.#workers.splice(0)) worker.terminate();
  }

  /** Threads of Node have `ref` and `unref`: a process that waits for nothing else ends, whatever idle workers there are. */
  #ask({ worker, mailbox }, what, question) {
    worker.ref?.();
    return mailbox.ask({ what, question });
  }

  #settle({ worker, mailbox, failures }, { id, found, error }) {
    mailbox.settle({ id, found, error: error && (failures.get(id) ?? error) });
    failures.delete(id);
    if (mailbox.size === 0) worker.unref?.();
  }

  /** Bring the bytes that a worker needs for its question `of`. */
  #serve({ worker, failures }, { id, of, ranges }) {
    return answer(worker, id, async () => {
      try {
        // Copies: of parts, the whole would go to the worker.
        return (await this.#fetch(ranges)).map((bytes) => new Uint8Array(bytes));
      } catch (error) {
        failures.set(of, error);
        throw error;
      }
    });
  }

  /** All fail with one of them: what it was asked, nobody else was told. */
  #fail(message) {
    this.#failure ??= errorOf({ message });
    for (const { mailbox } of this.#workers) mailbox.fail(this.#failure);
  }
}
