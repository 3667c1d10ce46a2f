/** What the tables of methods predictive and rapid have in common. */

import { require } from "./errors.js";
import { inflateZlib } from "./inflate.js";

const MOST_WEIGHT = 32767;
const MOST_CHANGE = 65534;
const WHOLE = 4096;

/** Return a table of the annexes, `nBytes` of it, from deflated base64. */
export function unpackedTable(text, nBytes) {
  return inflateZlib(Uint8Array.from(atob(text), (character) => character.charCodeAt(0)), nBytes);
}

/** Return a reader of magnitudes (P.9): the one of a group, at most `limit`. */
export function magnitudeReader(decoder, models) {
  return (group, limit) => {
    const value = decoder.magnitude(models, 46 * group, 46 * group + 14, 0);
    require(value <= limit, "number in the parameters");
    return value;
  };
}

/** Return a stencil that differs from `base`; the tap core[0] is what the others leave of 4096. */
export function readChangedStencil(base, core, decoder, magnitude) {
  const unit = 2 ** decoder.raw(3);
  const stencil = base.slice();
  const [missing] = core;
  for (let i = 0; i < stencil.length; i++) {
    if (i === missing) continue;
    const change = magnitude(core.includes(i) ? 0 : 1, MOST_CHANGE);
    const isNegative = change > 0 && decoder.raw(1);
    stencil[i] += (isNegative ? -change : change) * unit;
  }
  stencil[missing] = 0;
  stencil[missing] = WHOLE - stencil.reduce((sum, weight) => sum + weight, 0);
  require(stencil.every((weight) => Math.abs(weight) <= MOST_WEIGHT), "weight of a stencil");
  return stencil;
}
