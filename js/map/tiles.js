/** Tiles of terrains, made in the browser: what asks the worker, and forgets what nobody wants. */

import { answer, mailboxOf } from "../src/mailbox.js";

/** Tiles under work, a view's: what is asked for later and dropped meanwhile is never begun. */
const AT_ONCE = 24;

export class TileMaker {
  #worker;
  #mailbox;
  #waiting = [];

  /** @param {{ worker?: Worker }} options */
  constructor({ worker } = {}) {
    this.#worker = worker ?? new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
    this.#mailbox = mailboxOf(this.#worker);
  }

  /**
   * Return what the worker answers: `what` is rgb, voids, plan, heightmap, mesh or height; `terrain` is
   * { name, url, described }, described as in terrains.json.
   */
  ask(terrain, what, args, signal) {
    return new Promise((resolve, reject) => {
      const { name, url, described } = terrain;
      const message = { terrain: { name, url: String(url), described }, what, args };
      this.#waiting.push({ message, resolve, reject, signal });
      this.#begin();
    });
  }

  /** Read the terrain of this name from a source { size, read(start, end) } of the page, not its URL. */
  bring(name, source) {
    const { port1: here, port2: port } = new MessageChannel();
    here.onmessage = ({ data: { id, start, end } }) =>
      answer(here, id, async () => [new Uint8Array(await source.read(start, end))]); // a copy, which moves
    this.#worker.postMessage({ brought: { name, size: source.size, port } }, [port]);
  }

  #begin() {
    while (this.#mailbox.size < AT_ONCE && this.#waiting.length) {
      const { message, resolve, reject, signal } = this.#waiting.shift();
      if (signal?.aborted) reject(new DOMException("not wanted any more", "AbortError"));
      else this.#mailbox.ask(message).then(resolve, reject).finally(() => this.#begin());
    }
  }
}

/** Return the terrains that `terrainwave publish` wrote: { name, url, described }. */
export async function publishedTerrains(url = "terrains.json") {
  const at = new URL(url, globalThis.document?.baseURI);
  const answer = await fetch(at);
  if (!answer.ok) throw new Error(`${at}: the server answered ${answer.status}`);
  return (await answer.json()).map((described) => ({
    name: described.name, url: new URL(described.file, at), described,
  }));
}

/** Return west, south, east, north as maps take them: all the way round where they reach beyond 180 degrees. */
export function heldBounds([west, south, east, north]) {
  return east > 180 ? [-180, south, 180, north] : [west, south, east, north];
}
