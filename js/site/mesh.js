/** The mesh of a part of the map within a tolerance: right triangles, as lines on the map, with their measured error. */

import Martini from "./martini/martini.js";

/** Samples on a side of the grid, a power of 2 and 1. */
export const SIDE = 513;
/** Triangles that a map draws in a moment. */
const MOST_DRAWN = 40000;
/** Below this tolerance a mesh of all places is tried. */
const LEAST = 1e-6;
const martini = new Martini(SIDE);

/** Return what makes meshes of `known`, SIDE x SIDE heights of a part of the map, NaN where void. */
export function mesher(known) {
  const lowest = known.reduce((low, height) => (height < low ? height : low), Infinity);
  const tile = martini.createTile(Float32Array.from(known, (height) => (Number.isNaN(height) ? lowest : height)));

  /** Return { triangles, error, nOutside }: three places [column, row] of each, how far samples are, how many lie in none. */
  const meshed = (asked) => {
    const { vertices, triangles: corners } = tile.getMesh(asked);
    const triangles = [];
    const isCovered = new Uint8Array(known.length);
    let error = 0;
    for (let i = 0; i < corners.length; i += 3) {
      const places = [...corners.subarray(i, i + 3)].map((at) => [vertices[2 * at], vertices[2 * at + 1]]);
      if (places.some(([col, row]) => Number.isNaN(known[row * SIDE + col]))) continue;
      triangles.push(places);
      error = Math.max(error, distanceOf(known, places, isCovered));
    }
    return { triangles, error, nOutside: known.reduce((n, height, i) => n + (height === height && !isCovered[i]), 0) };
  };

  /** Return { lines, nTriangles, error, nOutside } within a tolerance: pairs of places, none of too many triangles. */
  return (tolerance) => {
    let found = meshed(tolerance);
    // Martini adds no errors up: samples may be further away than it was asked for.
    for (let asked = tolerance; found.error > tolerance; found = meshed(asked)) {
      asked = asked > LEAST ? 0.9 * asked * (tolerance / found.error) : 0;
    }
    const { triangles, error, nOutside } = found;
    const edges = new Map();
    for (const places of triangles.length > MOST_DRAWN ? [] : triangles) {
      places.forEach((from, k) => {
        const ends = [from, places[(k + 1) % 3]];
        const [one, other] = ends.map(([col, row]) => row * SIDE + col);
        edges.set(Math.min(one, other) * SIDE * SIDE + Math.max(one, other), ends);
      });
    }
    return { lines: [...edges.values()], nTriangles: triangles.length, error, nOutside };
  };
}

/** Return the largest vertical distance of samples from a triangle over them, which `isCovered` notes. */
function distanceOf(known, [[ax, ay], [bx, by], [cx, cy]], isCovered) {
  const heightOf = (x, y) => known[y * SIDE + x];
  const twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay);
  let largest = 0;
  for (let y = Math.min(ay, by, cy); y <= Math.max(ay, by, cy); y++) {
    for (let x = Math.min(ax, bx, cx); x <= Math.max(ax, bx, cx); x++) {
      const u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / twice;
      const v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / twice;
      if (u < 0 || v < 0 || u + v > 1) continue;
      isCovered[y * SIDE + x] = 1;
      const height = u * heightOf(ax, ay) + v * heightOf(bx, by) + (1 - u - v) * heightOf(cx, cy);
      const distance = Math.abs(height - heightOf(x, y));
      if (distance > largest) largest = distance; // NaN, of a void, is not
    }
  }
  return largest;
}
