/** The decoder as a WebAssembly module, compiled once for a page. */

import { CORE } from "./core-data.js";
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
  if (typeof WebAssembly !== "object" || typeof DecompressionStream !== "function") {
    throw new TerrainwaveError(
      "this browser lacks WebAssembly or DecompressionStream, which decode heights: use a newer one",
    );
  }
  const packed = Uint8Array.from(atob(CORE), (character) => character.charCodeAt(0));
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = await new Response(unpacked).arrayBuffer();
  try {
    return await WebAssembly.compile(bytes);
  } catch (cause) {
    // A policy forbids to compile, not to look whether it could be done.
    throw new TerrainwaveError(WebAssembly.validate(bytes)
      ? "the page forbids WebAssembly, which decodes heights: let its header Content-Security-Policy" +
        ` say script-src 'self' 'wasm-unsafe-eval' (${cause.message})`
      : "this browser's WebAssembly lacks SIMD, which decodes heights: use a newer one", { cause });
  }
}
