/** Planes of method predictive by compiled kernels: the arrays lie in their memory. */

import { kernels } from "./kernels.js";
import { EIGHTHS, LOGITS, MIXED } from "./predictive-bits.js";
import { PARITY, REACH } from "./predictive-lattice.js";
import { PLACES } from "./predictive-plane.js";
import { RATES } from "./rangecoder.js";

const MOST_TAPS = 24;
const N_PARAMETERS = 40;

/** Memory for units of one size and smaller ones. */
class Room {
  constructor(nRegion, nLattice, nData, nModels, nMixers) {
    Object.assign(this, { nRegion, nLattice, nData });
    const numbers = [Int32Array, nLattice];
    const region = [Uint8Array, nRegion];
    Object.assign(this, kernels.predictive.arrange({
      parameters: [Int32Array, N_PARAMETERS], heights: [Int32Array, nRegion], valid: region,
      known: region, values: numbers, errors: numbers, activity: numbers, bends: numbers,
      ownErrors: numbers, taps: [Int32Array, MOST_TAPS], core: [Int32Array, 4],
      stencil: [Int32Array, MOST_TAPS], weights: [Int32Array, 18], cells: [Int32Array, nModels],
      mixers: [BigInt64Array, nMixers], state: [Int32Array, 3], data: [Uint8Array, nData],
      logits: [Int32Array, LOGITS.length], mixed: [Int32Array, MIXED.length],
      rates: [Int32Array, RATES.length], eighths: [Uint8Array, EIGHTHS.length],
    }));
    this.logits.set(LOGITS);
    this.mixed.set(MIXED);
    this.rates.set(RATES);
    this.eighths.set(EIGHTHS);
  }

  hasRoomFor(nRegion, nLattice, nData) {
    return nRegion <= this.nRegion && nLattice <= this.nLattice && nData <= this.nData;
  }
}

let room = null;

/** Decodes the planes of one unit; `heights` and the decoder's stream move into the memory. */
export class KernelUnit {
  /** `unit` is what PlaneDecoder takes of one. */
  constructor({ rows, cols }, heights, unit) {
    const { decoder, valid, known, models, mixers } = unit;
    const nLattice = (rows.nCore + 2 * REACH) * (cols.nCore + 2 * REACH);
    const n = heights.length;
    if (!room?.hasRoomFor(n, nLattice, decoder.data.length)) {
      const nModels = models.cells.length;
      room = new Room(n, nLattice, 2 * decoder.data.length + 64, nModels, mixers.weights.length);
    }
    this.unit = unit;
    this.nData = decoder.data.length;
    this.heights = room.heights.subarray(0, n);
    this.heights.set(heights);
    room.valid.set(valid);
    room.known.set(known);
    room.cells.set(models.cells);
    room.mixers.fill(32768n);
    room.data.set(decoder.data);
    room.state.set(decoder.state);
    decoder.data = room.data.subarray(0, this.nData);
    decoder.state = room.state;
  }

  /** Return arrays of a lattice of n numbers. */
  arrays(n) {
    const cleared = (array) => array.subarray(0, n).fill(0);
    const { values, errors, activity, bends } = room;
    return {
      values: cleared(values), errors: cleared(errors), activity: cleared(activity),
      bends: cleared(bends),
    };
  }

  decodePlane(lattice, plane, stencil, weights) {
    const { step, scale, isMixed, isClamped, zMin, zMax } = this.unit;
    const { taps, core } = PLACES[plane];
    const offset = ([r, c]) => r * lattice.pitch + c;
    const [down, right] = PARITY[plane];
    const nRows = (lattice.nRows + 1 - down) >> 1;
    const nCols = (lattice.nCols + 1 - right) >> 1;
    room.taps.set(taps.map(offset));
    room.core.set(core.map(offset));
    room.stencil.set(stencil);
    room.weights.set(weights);
    room.ownErrors.fill(0, 0, 2 * (nCols + 3));
    room.parameters.set([
      plane, nRows, nCols, lattice.pitch,
      lattice.at(down, right), lattice.place(down, right), 2 * lattice.stride,
      lattice.place(2, 0) - lattice.place(0, 0),
      isMixed ? 1 : 0, isClamped ? 1 : 0, step, zMin, zMax, Math.log2(scale.unit), scale.inverse,
      taps.length, this.nData,
      ...[
        room.values, room.errors, room.activity, room.bends, room.ownErrors, room.heights, room.valid,
        room.known, room.taps, room.core, room.stencil, room.weights, room.cells, room.mixers,
        room.state, room.data, room.logits, room.mixed, room.rates, room.eighths,
      ].map((array) => array.byteOffset),
    ]);
    kernels.predictive.run.decodePlane(room.parameters.byteOffset);
    lattice.surround(PARITY[plane]);
  }
}
