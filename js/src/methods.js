/** The methods that this reader decodes, by name (FORMAT.md §4.1). */

import { decodeStore } from "./store.js";

/** `prepare` makes tables of parameters and header; `decode` gives the heights of a region. */
export const METHODS = {
  store: { prepare: () => null, decode: decodeStore },
};
