/** The methods that this reader decodes, by name (FORMAT.md §4.1). */

import { decodeRapid } from "./rapid.js";
import { readRapidTables } from "./rapid-tables.js";
import { decodeStore } from "./store.js";

/** `prepare` makes tables of parameters and header; `decode` gives the heights of a region. */
export const METHODS = {
  store: { prepare: () => null, decode: decodeStore },
  rapid: { prepare: readRapidTables, decode: decodeRapid },
};
