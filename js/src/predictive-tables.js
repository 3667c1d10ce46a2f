/** Tables of a file of method predictive (P.9, P.10 of docs/format-predictive.md). */

import { require, requireKnown } from "./errors.js";
import { E_WEIGHTS, STARTS, STENCILS } from "./predictive-data.js";
import { Models, RangeDecoder } from "./rangecoder.js";
import { magnitudeReader, readChangedStencil, unpackedTable } from "./stencils.js";

const N_DETAIL_MODELS = 22931;
const N_BORDER_MODELS = 2860;
const N_FEATURES = 18;
const MOST_SETS = 16;
/** Indices among the taps of a stencil, by plane HH, HL, LH: those of the core, its first first. */
const CORE_TAPS = [[9, 10, 13, 14], [4, 5, 8, 9], [4, 5, 8, 9]];

let starts = null;

/** Return { details, border }: the models that a unit begins with. */
export function startModels() {
  if (starts === null) {
    const bytes = unpackedTable(STARTS, 2 * (N_DETAIL_MODELS + N_BORDER_MODELS));
    const all = Uint16Array.from({ length: bytes.length / 2 }, (_, i) =>
      bytes[2 * i] + 256 * bytes[2 * i + 1],
    );
    starts = {
      details: new Models(N_DETAIL_MODELS, all.subarray(0, N_DETAIL_MODELS)),
      border: new Models(N_BORDER_MODELS, all.subarray(N_DETAIL_MODELS)),
    };
  }
  return { details: starts.details.copy(), border: starts.border.copy() };
}

/** Return { stencils[plane][set], weights[plane][class] }, those of the file after the annex's. */
export function readPredictiveTables(parameters) {
  const tables = { stencils: STENCILS.map((sets) => [...sets]), weights: E_WEIGHTS.map((w) => [...w]) };
  if (parameters.length === 0) return tables;
  requireKnown(parameters[0] === 1, `layout ${parameters[0]} of the parameters`);
  const decoder = new RangeDecoder(parameters.subarray(1));
  const models = new Models(138);
  const magnitude = magnitudeReader(decoder, models);
  for (let plane = 0; plane < 3; plane++) {
    const sets = tables.stencils[plane];
    const nTrained = sets.length;
    const nNew = decoder.raw(4);
    require(nTrained + nNew <= MOST_SETS, "number of stencils");
    for (let k = 0; k < nNew; k++) {
      const base = decoder.raw(4);
      require(base < nTrained, "base of a stencil");
      sets.push(readChangedStencil(sets[base], CORE_TAPS[plane], decoder, magnitude));
    }
    if (decoder.raw(1)) {
      tables.weights[plane].push(Array.from({ length: N_FEATURES }, () => magnitude(2, 4096)));
    }
  }
  decoder.end();
  return tables;
}
