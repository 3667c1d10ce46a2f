/**
 * Reads windows of one file: asks for bytes until the decoder has what it needs. `fetch` of each
 * question returns a promise of the bytes of many { start, end, isPage }.
 */

import { Core } from "./core.js";
import { SourceError } from "./errors.js";

export class Engine {
  #file;
  #core = null; // a promise

  /** `file` has the decoder's module, size, start (bytes from the file's first on) and cacheBytes. */
  constructor(file) {
    this.#file = file;
  }

  async #open(fetch) {
    const { module, size, start, cacheBytes } = this.#file;
    const core = await Core.start(module, size, cacheBytes);
    const held = [{ start: 0, bytes: start }];
    try {
      for (;;) {
        const missing = core.open(held);
        if (missing.length === 0) return { core, about: core.describe() };
        await this.#more(missing, held, fetch);
      }
    } catch (error) {
      core.end();
      throw error;
    }
  }

  async #more(missing, held, fetch) {
    const found = await fetch(missing);
    missing.forEach(({ start, end }, i) => {
      // Or the same would be missing for ever.
      if (found[i]?.length !== end - start) throw new SourceError(`bytes ${start} to ${end} did not come`);
      held.push({ start, bytes: found[i] });
    });
  }

  /** Return the file's decoder; a new one, where the last one broke off. */
  async #opened(fetch) {
    this.#core ??= this.#open(fetch);
    const mine = this.#core;
    try {
      const opened = await mine;
      if (!opened.core.isBroken) return opened;
    } catch (error) {
      if (this.#core === mine) this.#core = null; // another read tries again
      throw error;
    }
    if (this.#core === mine) this.#core = null;
    return this.#opened(fetch);
  }

  async describe(fetch) {
    return (await this.#opened(fetch)).about;
  }

  /**
   * Call `what` of the decoder until nothing is missing. A window is begun anew after each wait:
   * meanwhile others may have decoded its units, or the decoder may have broken off. `take`: see `Core.read`.
   */
  async ask(what, place, fetch, take) {
    const held = [{ start: 0, bytes: this.#file.start }];
    for (;;) {
      const { core } = await this.#opened(fetch);
      const { missing, found } = core[what](place, held, take);
      if (!missing) return found;
      await this.#more(missing, held, fetch);
    }
  }

  /** Give the memory back; nothing can be read any more. */
  async close() {
    const opened = await this.#core?.catch(() => null);
    opened?.core.end();
  }

  /** Return a digest of what is decoded: `what` is digest or rootOf of the decoder. */
  async digested(what, of, fetch) {
    return (await this.#opened(fetch)).core[what](of);
  }
}
