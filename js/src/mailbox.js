/** Questions to workers, which answer by their ids: { id, found } or { id, error }. */

export class Mailbox {
  #asked = new Map(); // by id: { resolve, reject, whom }
  #n = 0;
  #errorOf;

  /** `errorOf` makes an error of a worker's { name, message }. */
  constructor(errorOf) {
    this.#errorOf = errorOf;
  }

  /** Number of questions that wait for an answer. */
  get size() {
    return this.#asked.size;
  }

  /** Return the id of a new question to `whom`, and the promise of its answer. */
  ask(whom) {
    const id = this.#n++;
    const answer = new Promise((resolve, reject) => {
      this.#asked.set(id, { resolve, reject, whom });
    });
    return { id, answer };
  }

  /** Take an answer; return who was asked, undefined if nobody waits for it. */
  settle({ id, found, error }) {
    const asked = this.#asked.get(id);
    if (!asked) return undefined;
    this.#asked.delete(id);
    if (error) asked.reject(this.#errorOf(error));
    else asked.resolve(found);
    return asked.whom;
  }

  /** Return the questions that wait. */
  get ids() {
    return [...this.#asked.keys()];
  }
}
