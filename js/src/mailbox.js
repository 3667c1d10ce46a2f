/** Questions to workers and ports, { id, … }, which are answered by their ids: { id, found } or { id, error }. */

export class Mailbox {
  #port;
  #errorOf;
  #asked = new Map(); // by id: { resolve, reject }
  #n = 0;
  #failure = null;

  /** `errorOf` makes an error of another thread's { name, message }. */
  constructor(port, errorOf = ({ name, message }) => Object.assign(new Error(message), { name })) {
    this.#port = port;
    this.#errorOf = errorOf;
  }

  /** Number of questions that wait for an answer. */
  get size() {
    return this.#asked.size;
  }

  /** Return a promise of the answer to a question, which is an object. */
  ask(question) {
    const id = this.#n++;
    const answer = new Promise((resolve, reject) => this.#asked.set(id, { resolve, reject }));
    if (this.#failure) this.settle({ id, error: this.#failure });
    try {
      if (!this.#failure) this.#port.postMessage({ ...question, id });
    } catch (error) { // something in it cannot be sent
      this.settle({ id, error });
    }
    return answer;
  }

  /** Take an answer; one that nobody waits for is dropped. */
  settle({ id, found, error }) {
    const asked = this.#asked.get(id);
    this.#asked.delete(id);
    if (error) asked?.reject(error instanceof Error ? error : this.#errorOf(error));
    else asked?.resolve(found);
  }

  /** Refuse all that waits, and all that is asked from now on. */
  fail(error) {
    this.#failure ??= error;
    for (const id of this.#asked.keys()) this.settle({ id, error });
  }
}

/** Return the mailbox of a page's worker. */
export function mailboxOf(worker) {
  const mailbox = new Mailbox(worker);
  worker.onmessage = ({ data }) => mailbox.settle(data);
  worker.onerror = (event) => {
    event.preventDefault();
    mailbox.fail(new Error(event.message ?? "the module of the worker cannot be loaded"));
  };
  return mailbox;
}

/** Answer a question of another thread by what `work` returns, or by its error. */
export async function answer(port, id, work) {
  try {
    const found = await work();
    // Parts that can be moved are not copied.
    const moved = Object.values(found ?? {}).map((value) => (ArrayBuffer.isView(value) ? value.buffer : value))
      .filter((value) => value instanceof ArrayBuffer || isImage(value));
    port.postMessage({ id, found }, moved);
  } catch ({ name, message }) {
    port.postMessage({ id, error: { name, message } });
  }
}

const isImage = (value) => typeof ImageBitmap === "function" && value instanceof ImageBitmap;
