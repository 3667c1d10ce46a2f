/** The mesh of a part of the map within a tolerance: right triangles, as lines on the map, with their measured error. */

import Martini from "./martini/martini.js";

/** Samples on a side of the grid, a power of 2 and 1. */
export const SIDE = 513;
/** Triangles that a map draws in a moment. */
const MOST_DRAWN = 40000;
const martini = new Martini(SIDE);

/** Return what makes meshes of `known`, SIDE x SIDE heights of a part of the map, NaN where void. */
export function mesher(known) {
  const lowest = known.reduce((low, height) => (height < low ? height : low), Infinity);
  const tile = martini.createTile(Float32Array.from(known, (height) => (Number.isNaN(height) ? lowest : height)));

  /**
   * Return { lines, nTriangles, error }: pairs of places [column, row], none of too many triangles, and how far
   * samples are from the mesh.
   */
  return (tolerance) => {
    const { vertices, triangles } = tile.getMesh(tolerance);
    const edges = new Map();
    const isDrawn = triangles.length <= 3 * MOST_DRAWN;
    let [nTriangles, error] = [0, 0];
    for (let i = 0; i < triangles.length; i += 3) {
      const corners = [0, 1, 2].map((k) => triangles[i + k]);
      const places = corners.map((at) => [vertices[2 * at], vertices[2 * at + 1]]);
      if (places.some(([col, row]) => Number.isNaN(known[row * SIDE + col]))) continue;
      nTriangles++;
      error = Math.max(error, distanceOf(known, places));
      if (!isDrawn) continue;
      corners.forEach((at, k) => {
        const next = (k + 1) % 3;
        const key = Math.min(at, corners[next]) * SIDE * SIDE + Math.max(at, corners[next]);
        edges.set(key, [places[k], places[next]]);
      });
    }
    return { lines: [...edges.values()], nTriangles, error };
  };
}

/** Return the largest vertical distance of samples from a triangle over them. */
function distanceOf(known, [[ax, ay], [bx, by], [cx, cy]]) {
  const heightOf = (x, y) => known[y * SIDE + x];
  const twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay);
  let largest = 0;
  for (let y = Math.min(ay, by, cy); y <= Math.max(ay, by, cy); y++) {
    for (let x = Math.min(ax, bx, cx); x <= Math.max(ax, bx, cx); x++) {
      const u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / twice;
      const v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / twice;
      if (u < 0 || v < 0 || u + v > 1) continue;
      const height = u * heightOf(ax, ay) + v * heightOf(bx, by) + (1 - u - v) * heightOf(cx, cy);
      const distance = Math.abs(height - heightOf(x, y));
      if (distance > largest) largest = distance; // NaN, of a void, is not
    }
  }
  return largest;
}
