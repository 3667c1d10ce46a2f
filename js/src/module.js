/** The decoder as a WebAssembly module, compiled once for a page. */

import { CORE, N_BYTES, UNPACK } from "./core-data.js";
import { TerrainwaveError } from "./errors.js";

let compiled = null;

/** Return a promise of the module. */
export function loadModule() {
  compiled ??= compile().catch((error) => {
    compiled = null; // another try may find more memory
    throw error;
  });
  return compiled;
}

async function compile() {
  if (typeof WebAssembly !== "object") {
    throw new TerrainwaveError("this browser lacks WebAssembly, which decodes heights: use a newer one");
  }
  let bytes = bytesOf(UNPACK);
  try {
    bytes = await unpacked(bytes);
    return await WebAssembly.compile(bytes);
  } catch (cause) {
    // A policy forbids to compile, not to look whether it could be done.
    throw new TerrainwaveError(WebAssembly.validate(bytes)
      ? "the page forbids WebAssembly, which decodes heights: let its header Content-Security-Policy" +
        ` say script-src 'self' 'wasm-unsafe-eval' (${cause.message})`
      : "this browser's WebAssembly lacks SIMD, which decodes heights: use a newer one", { cause });
  }
}

const bytesOf = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0));

/** Return the decoder's bytes: LZMA, by a small module (js/wasm/unpack.c), is faster than the browser's gzip. */
async function unpacked(module) {
  const { memory, place, unpack } = (await WebAssembly.instantiate(module)).instance.exports;
  const packed = bytesOf(CORE);
  const end = place() + packed.length + N_BYTES;
  memory.grow(Math.ceil(Math.max(end - memory.buffer.byteLength, 0) / 65536));
  new Uint8Array(memory.buffer, place(), packed.length).set(packed);
  return new Uint8Array(memory.buffer, unpack(packed.length, N_BYTES), N_BYTES);
}
