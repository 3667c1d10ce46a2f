/** Compiled kernels (js/wasm): the loops that take longest, where the engine lets us have them. */

import { inflateRaw } from "./inflate.js";
import { KERNELS, SIZE } from "./kernels-data.js";

const PAGE = 65536;

/** An instance and what lies in its memory: one user each, one unit at a time. */
class Kernels {
  constructor({ exports }) {
    this.run = exports;
  }

  /**
   * Return arrays in the memory, by the names of `layout`: { name: [Type, length] }. Those of
   * calls before are gone.
   */
  arrange(layout) {
    const { memory, __heap_base: base } = this.run;
    let at = base.value;
    const places = Object.entries(layout).map(([name, [Type, n]]) => {
      const start = Math.ceil(at / 16) * 16;
      at = start + n * Type.BYTES_PER_ELEMENT;
      return { name, Type, start, n };
    });
    const missing = at - memory.buffer.byteLength;
    if (missing > 0) memory.grow(Math.ceil(missing / PAGE));
    const { buffer } = memory;
    return Object.fromEntries(places.map(({ name, Type, start, n }) =>
      [name, new Type(buffer, start, n)],
    ));
  }
}

/** By what uses them: null until `loadKernels`, and where there is no WebAssembly with SIMD. */
export const kernels = { rapid: null, rapidWide: null, predictive: null, masks: null };
let loaded = null;

async function load() {
  try {
    const deflated = Uint8Array.from(atob(KERNELS), (character) => character.charCodeAt(0));
    const module = await WebAssembly.compile(inflateRaw(deflated, SIZE));
    for (const name of Object.keys(kernels)) {
      kernels[name] = new Kernels(await WebAssembly.instantiate(module));
    }
  } catch {
    // An old engine, or a page whose policy forbids it: plain JavaScript does the same.
  }
}

/** Load them once; what fails is done without. */
export function loadKernels() {
  loaded ??= load();
  return loaded;
}

/** Run with these kernels from now on; without, where there are none (for tests). */
export function useKernels(found) {
  for (const name of Object.keys(kernels)) kernels[name] = found[name] ?? null;
}
