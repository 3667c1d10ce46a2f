/** Threads of Node, by the words in which webpack finds a worker's module. */

import { Worker } from "worker_threads";

/** Return a thread that runs the module at `url`; by default read-worker.js, which lies next to this module. */
export function startThread(url) {
  if (url) return new Worker(url);
  if (import.meta.url) return new Worker(new URL("./read-worker.js", import.meta.url));
  return new Worker(`${__dirname}/read-worker.js`); // esbuild's bundles in CommonJS have no import.meta.url
}
