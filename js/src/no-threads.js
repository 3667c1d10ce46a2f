/** Takes the place of threads.js where there is no Node: pages have workers of their own. */

export function startThread() {
  throw new Error("neither Worker nor threads of Node are here");
}
