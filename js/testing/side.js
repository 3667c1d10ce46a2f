/** Reads that are timed alike in Node and on pages: by terrainwave and by geotiff.js, as their users call them. */

/** `terrainwave` and `geotiff` are the modules; `digestOf` returns a promise of what stands for an array. */
export function sides(terrainwave, geotiff, digestOf) {
  const pools = new Map(); // by number of workers: users of geotiff.js keep one
  const poolOf = (n) => {
    if (n > 0 && !pools.has(n)) pools.set(n, new geotiff.Pool(n));
    return pools.get(n) ?? null;
  };
  const place = ({ row, col, nRows, nCols }) => [col, row, col + nCols, row + nRows];
  const READ = {
    async terrainwave(terrain, window) {
      return (await terrain.read(-1, window)).heights;
    },
    async geotiff(image, window, workers) {
      return (await image.readRasters({ window: place(window), pool: poolOf(workers) }))[0];
    },
  };
  const OPEN = {
    // Workers are compared at what is decoded: nothing of it is kept.
    terrainwave: (from, workers) => terrainwave.open(from, { workers, ...(workers > 0 && { cacheBytes: 0 }) }),
    async geotiff(from) {
      const tiff = await (typeof from === "string" ? geotiff.fromUrl(from) : geotiff.fromArrayBuffer(from));
      return tiff.getImage();
    },
  };
  const kept = new Map(); // by who reads: the file that is open, of those who read by workers

  /**
   * Return { seconds, digest } of a read of `window`: one thread opens the file, too; by workers it is open,
   * and they run. `name` is the file's; a `from` that is no URL is in memory.
   */
  return async ({ who, name, from, window, workers }) => {
    const start = performance.now();
    let file = workers > 0 && kept.get(who)?.name === name ? kept.get(who).file : null;
    if (!file) {
      await kept.get(who)?.file.close?.();
      kept.delete(who);
      file = await OPEN[who](from, workers);
      if (workers > 0) kept.set(who, { name, file });
    }
    const heights = await READ[who](file, window, workers);
    if (workers === 0) await file.close?.(); // as Python's "with" does
    const seconds = (performance.now() - start) / 1000;
    return { seconds, digest: await digestOf(heights) };
  };
}
