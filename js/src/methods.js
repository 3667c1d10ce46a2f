/** The methods that this reader decodes, by name (FORMAT.md §4.1). */

import { decodePredictive } from "./predictive.js";
import { readPredictiveTables } from "./predictive-tables.js";
import { decodeRapid } from "./rapid.js";
import { readRapidTables } from "./rapid-tables.js";
import { decodeStore } from "./store.js";

/** `prepare` makes tables of parameters and header; `decode` gives the heights of a region. */
export const METHODS = {
  store: { prepare: () => null, decode: decodeStore },
  predictive: { prepare: readPredictiveTables, decode: decodePredictive },
  rapid: { prepare: readRapidTables, decode: decodeRapid },
};
