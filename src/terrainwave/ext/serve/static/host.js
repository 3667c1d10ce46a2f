// Answers to the page by the place where it is: on a web server by terrains.json and the address. In
// notebooks another module has this place (js/notebook/host.js).
import * as permalink from "./permalink.js";
import { terrains as asked } from "./terrains.js";

/** Return { terrains, source }: what can be shown, and where its tiles and heights come from. */
export async function listed(maplibre) {
  const terrains = await asked;
  const isPublished = terrains.some(({ file }) => file);
  const { open } = await import(isPublished ? "./published.js" : "./served.js");
  return { terrains, source: open(maplibre) };
}

/** Return what is to be seen, as `permalink.read` does. */
export function view() {
  return permalink.read(location.hash);
}

/** Take note of what is seen. */
export function keep(state, map) {
  history.replaceState(null, "", permalink.write(state, map));
}

/** Call when there is something else to be seen. */
export function follow(callback) {
  window.addEventListener("hashchange", callback);
}
