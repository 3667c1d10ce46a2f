/** What a terrain decodes to, in Node and in browsers alike. */

/** Return SHA-256 of heights and of validity, by level, as hexadecimal text. */
export async function levelDigests(terrain) {
  const { subtle } = globalThis.crypto;
  const digest = async (array) => {
    const found = new Uint8Array(await subtle.digest("SHA-256", array));
    return Array.from(found, (byte) => byte.toString(16).padStart(2, "0")).join("");
  };
  const levels = [];
  for (let level = 0; level < terrain.nLevels; level++) {
    const { heights, valid } = await terrain.read(level);
    levels.push([await digest(heights), await digest(valid)]);
  }
  return levels;
}
