/** Method predictive (docs/format-predictive.md, whose sections are cited as P.n). */

import { require } from "./errors.js";
import { kernels } from "./kernels.js";
import { Mixers, Scale } from "./predictive-bits.js";
import { Border } from "./predictive-border.js";
import { HH, LH, Lattice, PARITY } from "./predictive-lattice.js";
import { KernelUnit } from "./predictive-kernels.js";
import { PlaneDecoder } from "./predictive-plane.js";
import { startModels } from "./predictive-tables.js";
import { RangeDecoder } from "./rangecoder.js";

const SMALL = 1024; // lattices of fewer samples have no headers of planes

/** Return the heights of the region of a unit (P.1). */
export function decodePredictive(file, unit, payload, valid, parent, hasVoid, corrections) {
  require(payload.length >= 1, "a payload of predictive is empty");
  const flags = payload[0];
  require(flags < 4, "flags of predictive");
  const { header, grid, tables } = file;
  const decoder = new RangeDecoder(payload.subarray(1));
  const heights = new Int32Array(valid.length);
  const models = startModels();
  const border = new Border(decoder, models.border, unit, parent, heights, valid, header, grid.rings,
    corrections);
  let stride = 2;
  if (parent === null) {
    stride = border.decodeRootCorners();
  } else {
    border.decodeShared();
    border.takeParents();
  }
  const shared = {
    decoder, valid, known: border.known, corrections,
    models: models.details, mixers: new Mixers(22), scale: new Scale(header.step),
    isMixed: (flags & 1) !== 0, isClamped: (flags & 2) !== 0,
    step: header.step, zMin: header.zMin, zMax: header.zMax,
  };
  decodeLattices(tables, stride, unit, heights, shared);
  decoder.end();
  return heights;
}

/** Decode lattices of half the stride, a quarter and so on, into the heights of the region. */
function decodeLattices(tables, stride, unit, heights, shared) {
  // Kernels decode whole planes, and know of no corrections.
  const isCompiled = kernels.predictive && shared.corrections === null;
  const compiled = isCompiled ? new KernelUnit(unit, heights, shared) : null;
  const decode = (lattice, plane, stencil, weights) => {
    if (compiled) compiled.decodePlane(lattice, plane, stencil, weights);
    else new PlaneDecoder(lattice, plane, stencil, weights, shared).run();
  };
  for (stride /= 2; stride >= 1; stride /= 2) {
    const lattice = compiled
      ? new Lattice(unit, stride, compiled.heights, (n) => compiled.arrays(n))
      : new Lattice(unit, stride, heights);
    for (let plane = HH; plane <= LH; plane++) {
      if (!lattice.isEmpty(PARITY[plane])) decodePlane(tables, lattice, plane, shared, decode);
    }
  }
  if (compiled) heights.set(compiled.heights);
}

/** Read the header of a plane and decode it (P.5). */
function decodePlane(tables, lattice, plane, shared, decode) {
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
  decode(lattice, plane, stencils[plane][set], weights[plane][class_]);
}
