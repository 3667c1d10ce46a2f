/** Reads that are timed alike in Node and on pages: by terrainwave and by geotiff.js, as their users call them. */

/** `terrainwave` and `geotiff` are the modules; `digest` returns a promise of what stands for an array. */
export function sides(terrainwave, geotiff, digest) {
  const pools = new Map(); // by number of workers: users of geotiff.js keep one
  const poolOf = (n) => {
    if (n > 0 && !pools.has(n)) pools.set(n, new geotiff.Pool(n));
    return pools.get(n) ?? null;
  };
  let opened = null; // given back when the clock stands
  const READ = {
    async terrainwave(from, { row, col, nRows, nCols }, workers) {
      opened = await terrainwave.open(from, { workers });
      return (await opened.read(-1, { row, col, nRows, nCols })).heights;
    },
    async geotiff(from, { row, col, nRows, nCols }, workers) {
      const tiff = await (typeof from === "string" ? geotiff.fromUrl(from) : geotiff.fromArrayBuffer(from));
      const image = await tiff.getImage();
      const window = [col, row, col + nCols, row + nRows];
      return (await image.readRasters({ window, pool: poolOf(workers) }))[0];
    },
  };

  /** Return { seconds, digest } of a read of `window`; a `from` that is no URL is in memory. */
  return async ({ who, from, window, workers }) => {
    const start = performance.now();
    const heights = await READ[who](from, window, workers);
    const seconds = (performance.now() - start) / 1000;
    await opened?.close();
    opened = null;
    return { seconds, digest: await digest(heights) };
  };
}
