/**
 * The map of `Terrain.explore` in a notebook: the page of `terrainwave publish` in a frame. What it
 * is made of and what it shows come from the kernel, by the messages of the widget: src/terrainwave/
 * ext/notebook/channel.py. It is one module without imports, as anywidget takes it.
 */

/** Limits of a message that the kernel takes, and of messages that wait for it at a time. */
const MOST_BYTES = 1 << 23;
const MOST_RANGES = 64;
const MOST_WAITING = 4;
/** Milliseconds in which wishes are gathered, and after which a kernel that has not heard is busy. */
const GATHERING = 5;
const BUSY_AFTER = 1000;
const BUSY = "The kernel is busy: the map waits, and goes on by itself.";
const SILENT = "The kernel is busy, or there is none: the map waits for it, and goes on by itself.";
const ENDED = "The kernel of this map has ended: run the cell again.";

/** The kernel as one view asks it; `tell` is called with a line about its state, or with none. */
export class Kernel {
  #model;
  #tell;
  #name = `${Date.now()}-${Math.random()}-`; // of this view, among all that hear the answers
  #count = 0;
  #asked = new Map(); // by id: { resolve, reject, isTaken }
  #wanted = []; // ranges
  #nReading = 0;
  #busy = null;
  #isHeard = false;
  #hasEnded = false;

  constructor(model, tell) {
    this.#model = model;
    this.#tell = tell;
    model.on("msg:custom", this.#take);
    model.on("comm_live_update", this.#break);
  }

  /** Ask for `what`; return a promise of { ...answer, buffers }. */
  ask(what, question = {}) {
    if (this.#hasEnded) return Promise.reject(new Error(ENDED));
    const id = this.#name + this.#count++;
    return new Promise((resolve, reject) => {
      this.#asked.set(id, { resolve, reject, isTaken: false });
      this.#busy ??= this.#soonBusy();
      this.#model.send({ ...question, id, what });
    });
  }

  /** Return a promise of the bytes start … end - 1 of the file. */
  async read(start, end) {
    const parts = [];
    for (let at = start; at < end; at += MOST_BYTES) {
      parts.push(this.#readPart(at, Math.min(at + MOST_BYTES, end)));
    }
    const found = await Promise.all(parts);
    return found.length === 1 ? found[0] : new Uint8Array(await new Blob(found).arrayBuffer());
  }

  /** Ask no more, and hear no more: who waits is told. */
  end() {
    this.#hasEnded = true;
    clearTimeout(this.#busy);
    for (const { reject } of this.#asked.values()) reject(new Error(ENDED));
    this.#model.off("msg:custom", this.#take);
    this.#model.off("comm_live_update", this.#break);
  }

  #soonBusy() {
    return setTimeout(() => this.#tell(this.#isHeard ? BUSY : SILENT), BUSY_AFTER);
  }

  #readPart(start, end) {
    return new Promise((resolve, reject) => {
      if (this.#wanted.length === 0) setTimeout(() => this.#readWanted(), GATHERING);
      this.#wanted.push({ start, end, resolve, reject });
    });
  }

  #readWanted() {
    while (this.#wanted.length && this.#nReading < MOST_WAITING) {
      let [n, size] = [0, 0];
      for (const { start, end } of this.#wanted) {
        if (n === MOST_RANGES || size + end - start > MOST_BYTES) break;
        size += end - start;
        n++;
      }
      this.#readRanges(this.#wanted.splice(0, n));
    }
  }

  async #readRanges(wanted) {
    this.#nReading++;
    try {
      const ranges = wanted.map(({ start, end }) => [start, end]);
      const { buffers } = await this.ask("ranges", { ranges });
      wanted.forEach(({ resolve }, i) => resolve(bytesOf(buffers[i])));
    } catch (error) {
      for (const { reject } of wanted) reject(error);
    }
    this.#nReading--;
    this.#readWanted();
  }

  #take = ({ id, taken, error, ...answer }, buffers) => {
    const asked = this.#asked.get(id);
    if (!asked) return; // another view's
    asked.isTaken = this.#isHeard = true;
    if (!taken) this.#asked.delete(id);
    clearTimeout(this.#busy);
    this.#tell("");
    const areTaken = [...this.#asked.values()].every(({ isTaken }) => isTaken);
    this.#busy = areTaken ? null : this.#soonBusy();
    if (taken) return;
    if (error) asked.reject(Object.assign(new Error(error.message), { name: error.name }));
    else asked.resolve({ ...answer, buffers });
  };

  #break = () => {
    this.end();
    this.#tell(ENDED);
  };
}

const bytesOf = ({ buffer, byteOffset, byteLength }) => new Uint8Array(buffer, byteOffset, byteLength);

/** Return the text of what came compressed. */
async function textOf(packed) {
  const unpacked = new Blob([bytesOf(packed)]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(unpacked).text();
}

const TYPES = { html: "text/html", css: "text/css" };
/** Names of other files: in modules relative to them, in the page below it. */
const NAMED = /(\bfrom |\bimport |\bimport\(|\bhref=|\bsrc=)"((?:\.|static\/)[^"]+)"|new URL\("(\.[^"]+)", import\.meta\.url\)/g;

/** Return the address of the page among files { name: text }, each by an address of its own. */
export function addressOf(page, files) {
  const addresses = new Map();
  const make = (name) => {
    if (!(name in files)) throw new Error(`the map lacks ${name}`);
    if (!addresses.has(name)) {
      const at = (found) => make(new URL(found, `file:///${name}`).pathname.slice(1));
      const text = name.includes("maplibre/") ? files[name] : files[name].replace(
        NAMED, (_, before, named, worker) => (worker ? `"${at(worker)}"` : `${before}"${at(named)}"`),
      );
      const type = TYPES[name.split(".").at(-1)] ?? "text/javascript";
      addresses.set(name, URL.createObjectURL(new Blob([text], { type })));
    }
    return addresses.get(name);
  };
  return make(page);
}

const PAGES = Symbol.for("terrainwave.pages");

/** Return a promise of the page's address, made once for all maps of a notebook. */
function pageOf(kernel, version) {
  const pages = (globalThis[PAGES] ??= new Map()); // by version
  if (!pages.has(version)) {
    const made = kernel.ask("page").then(async ({ names, buffers }) => {
      const texts = await Promise.all(buffers.map(textOf));
      return addressOf("index.html", Object.fromEntries(names.map((name, i) => [name, texts[i]])));
    });
    pages.set(version, made);
    made.catch(() => pages.delete(version)); // another map asks again
  }
  return pages.get(version);
}

const LOOK = {
  place: "position: relative; width: 100%; overflow: hidden",
  frame: "width: 100%; height: 100%; border: 0; display: block",
  note: "position: absolute; bottom: 44px; left: 50%; transform: translateX(-50%); margin: 0; padding: 6px 12px;"
    + " max-width: 80%; box-sizing: border-box; border-radius: 8px; color: #1a1a1a; background: #ffd479;"
    + " font: 13px/1.45 system-ui, sans-serif",
};

function made(tag, look, properties) {
  return Object.assign(document.createElement(tag), { style: look, ...properties });
}

async function show({ model, frame }, kernel) {
  const [address, { terrain, size }] = await Promise.all([
    pageOf(kernel, model.get("_page")), kernel.ask("terrain"),
  ]);
  const source = { size, read: (start, end) => kernel.read(start, end) };
  frame.terrainwave = { model, terrain, source, kernel }; // for host.js, which runs in the frame
  frame.src = address;
}

function render({ model, el }) {
  const place = made("div", LOOK.place);
  const frame = made("iframe", LOOK.frame, { title: "Terrain" });
  const note = made("p", LOOK.note, { role: "status", className: "terrainwave-note", hidden: true });
  const tell = (line) => {
    note.textContent = line;
    note.hidden = line === "";
  };
  const fit = () => { place.style.height = `${model.get("height")}px`; };
  const kernel = new Kernel(model, tell);
  model.on("change:height", fit);
  fit();
  place.append(frame, note);
  el.append(place);
  show({ model, frame }, kernel).catch(({ message }) => tell(`The terrain cannot be shown: ${message}`));
  return () => {
    kernel.end();
    model.off("change:height", fit);
  };
}

export default { render };
