/** Digests of what a terrain decodes to, in Node and in browsers alike. */

const { subtle } = globalThis.crypto ?? (await import("node:crypto")).webcrypto; // Node 18

/** Return the SHA-256 of an array, as hexadecimal text. */
export async function digestOf(array) {
  const found = new Uint8Array(await subtle.digest("SHA-256", array));
  return Array.from(found, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Return size and digests of a level, as tests/golden/README.md defines them. */
export async function digestOfLevel(terrain, level) {
  const { heights, valid, nRows, nCols } = await terrain.read(level, {}, { voids: "any" });
  const found = { rows: nRows, cols: nCols, heights: await digestOf(heights), mask: await digestOf(valid) };
  if (!terrain.hasVoids) return found;
  const exact = await terrain.read(level, {}, { voids: "exact" });
  return { ...found, own: await digestOf(exact.valid) };
}

/** Return those of all levels. */
export async function digests(terrain) {
  const levels = [];
  for (let k = 0; k < terrain.nLevels; k++) levels.push(await digestOfLevel(terrain, k));
  return levels;
}
