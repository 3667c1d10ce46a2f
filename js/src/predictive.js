/** Method predictive (docs/format-predictive.md, whose sections are cited as P.n). */

import { require } from "./errors.js";
import { Mixers, Scale } from "./predictive-bits.js";
import { Border } from "./predictive-border.js";
import { HH, LH, Lattice, PARITY } from "./predictive-lattice.js";
import { PlaneDecoder } from "./predictive-plane.js";
import { startModels } from "./predictive-tables.js";
import { RangeDecoder } from "./rangecoder.js";

const SMALL = 1024; // lattices of fewer samples have no headers of planes

/** Return the heights of the region of a unit (P.1). */
export function decodePredictive(file, unit, payload, valid, parent) {
  require(payload.length >= 1, "a payload of predictive is empty");
  const flags = payload[0];
  require(flags < 4, "flags of predictive");
  const { header, grid, tables } = file;
  const decoder = new RangeDecoder(payload.subarray(1));
  const heights = new Int32Array(valid.length);
  const models = startModels();
  const border = new Border(decoder, models.border, unit, parent, heights, valid, header, grid.rings);
  let stride = 2;
  if (parent === null) {
    stride = border.decodeRootCorners();
  } else {
    border.decodeShared();
    border.takeParents();
  }
  const shared = {
    decoder, valid, known: border.known,
    models: models.details, mixers: new Mixers(22), scale: new Scale(header.step),
    isMixed: (flags & 1) !== 0, isClamped: (flags & 2) !== 0,
    step: header.step, zMin: header.zMin, zMax: header.zMax,
  };
  while (stride > 1) {
    stride /= 2;
    const lattice = new Lattice(unit, stride, heights);
    for (let plane = HH; plane <= LH; plane++) {
      if (!lattice.isEmpty(PARITY[plane])) decodePlane(tables, lattice, plane, shared);
    }
  }
  decoder.end();
  return heights;
}

/** Read the header of a plane and decode it (P.5). */
function decodePlane(tables, lattice, plane, shared) {
  let set = 0;
  let class_ = 2;
  if (lattice.nRows * lattice.nCols >= SMALL) {
    const number = shared.decoder.raw(6);
    set = number >> 2;
    class_ = number & 3;
  }
  require(set < tables.stencils[plane].length, "set of a plane");
  require(class_ < tables.weights[plane].length, "class of a plane");
  const { stencils, weights } = tables;
  new PlaneDecoder(lattice, plane, stencils[plane][set], weights[plane][class_], shared).run();
}
