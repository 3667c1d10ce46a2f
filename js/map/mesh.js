/** Meshes of tiles in Web Mercator: grids of triangles, with skirts, as deck.gl draws them. */

import { sampledGrid } from "./heightmap.js";
import { latitudeOf, longitudeOf, spacingOf } from "./terrain-rgb.js";

/** Of the world in deck.gl's common space. */
const WORLD = 512;
/** Metres, even where a tile has no error: neighbours of other zooms differ by rounding, too. */
const LEAST_SKIRT = 1;

/**
 * Return { positions, normals, places, indices, lowest, highest, error, terrainError } of a tile z/x/y
 * (XYZ), of size x size vertices.
 *
 * `positions` are x and y in deck.gl's common space, north up, and heights in metres; `normals` are not
 * normalised; `places`, from 0 to 1, east and south, are for textures. Cells with a void corner are left
 * out. Skirts hang from the tile's edges, twice as long as the tile is wrong. Errors: see `heightmap`.
 */
export async function gridMesh(globe, z, x, y, size) {
  const around = size + 2; // normals on the tile's edge need what is beyond it
  const share = Array.from({ length: 2 * around - 1 }, (_, i) => (i / 2 - 1) / (size - 1));
  const lon = share.map((at) => longitudeOf(z, x + at));
  const lat = share.map((at) => latitudeOf(z, y + at));
  const spacing = spacingOf(globe, z, y, size - 1);
  const { known, error, terrainError } = await sampledGrid(globe, lon, lat, around, spacing);
  const skirt = Math.max(2 * (error + (terrainError ?? 0)), LEAST_SKIRT);
  const heightAt = (i, j) => known[(i + 1) * around + j + 1];
  const nVertices = size * size + 4 * size;
  const [positions, normals] = [new Float32Array(3 * nVertices), new Float32Array(3 * nVertices)];
  const places = new Float32Array(2 * nVertices);
  let [lowest, highest] = [Infinity, -Infinity];
  let nPut = 0;
  const put = (i, j, depth) => {
    const height = heightAt(i, j);
    if (height < lowest) lowest = height;
    if (height > highest) highest = height;
    const [u, v] = [j / (size - 1), i / (size - 1)];
    // Voids are in no triangle, but buffers want numbers.
    const at = [((x + u) / 2 ** z) * WORLD, (1 - (y + v) / 2 ** z) * WORLD, (height || 0) - depth];
    positions.set(at, 3 * nPut);
    const east = slope(heightAt(i, j - 1), height, heightAt(i, j + 1));
    const south = slope(heightAt(i - 1, j), height, heightAt(i + 1, j));
    normals.set([-east, south, spacing], 3 * nPut);
    places.set([u, v], 2 * nPut);
    return nPut++;
  };
  for (let at = 0; at < size * size; at++) put(Math.floor(at / size), at % size, 0);

  const indices = [];
  const isThere = (...vertices) =>
    vertices.every((at) => !Number.isNaN(heightAt(Math.floor(at / size), at % size)));
  for (let i = 0; i < size - 1; i++) {
    for (let j = 0; j < size - 1; j++) {
      const at = i * size + j;
      if (!isThere(at, at + 1, at + size, at + size + 1)) continue;
      indices.push(at, at + size, at + 1, at + 1, at + size, at + size + 1);
    }
  }
  const edges = [[0, 1], [size * (size - 1), 1], [0, size], [size - 1, size]]; // first vertex, and to the next
  for (const [first, step] of edges) {
    for (let k = 0, at = first; k < size; k++, at += step) {
      const below = put(Math.floor(at / size), at % size, skirt);
      if (k > 0 && isThere(at - step, at)) indices.push(at - step, below - 1, at, at, below - 1, below);
    }
  }
  if (highest < lowest) lowest = highest = globe.lowest; // nothing is there
  return {
    positions, normals, places, indices: Uint32Array.from(indices), lowest, highest, error, terrainError,
  };
}

/** Return how much a surface rises from one vertex to the next; 0 where nothing tells. */
function slope(before, here, after) {
  const both = (after - before) / 2;
  return [both, after - here, here - before].find((rise) => !Number.isNaN(rise)) ?? 0;
}
