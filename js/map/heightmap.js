/** Height maps of tiles in longitude and latitude (TMS as Cesium counts: rows from the north). */

import { VOID_DEPTH } from "./terrain-rgb.js";
import { largestDistance } from "./surfaces.js";

/** Return west, south, east, north of a tile; there are 2 x 1 on zoom 0. */
export function rectangleOf(z, x, y) {
  const side = 180 / 2 ** z;
  return [x * side - 180, 90 - (y + 1) * side, (x + 1) * side - 180, 90 - y * side];
}

/** Say whether a tile meets what [west, south, east, north] covers; east may be beyond 180. */
export function meets([west, south, east, north], z, x, y) {
  const [left, bottom, right, top] = rectangleOf(z, x, y);
  return bottom < north && top > south &&
    [-360, 0, 360].some((turn) => left + turn < east && right + turn > west);
}

/**
 * Return { heights, holes, error, terrainError }: size x size heights in metres, Float32Array, from the
 * north-west corner on, the outer ones on the tile's edges.
 *
 * Voids and what lies beside the raster are 1 m below the lowest height. `holes` has 1 where the raster
 * is void; null without voids. `error`: how far the map's
 * bilinear surface is from that of the samples read, at its places and halfway between them, where
 * nothing is void; `terrainError`: how far originals can be from the latter.
 */
export async function heightmap(globe, z, x, y, size) {
  const [west, south, east, north] = rectangleOf(z, x, y);
  const n = 2 * size - 1;
  const share = (i) => i / (n - 1);
  const lon = Array.from({ length: n }, (_, i) => west + share(i) * (east - west));
  const lat = Array.from({ length: n }, (_, i) => north - share(i) * (north - south));
  const spacing = ((north - south) / (size - 1) / 180) * Math.PI * globe.axis;
  const { known, places, ...errors } = await sampledGrid(globe, lon, lat, size, spacing);
  const ofVoids = globe.lowest - VOID_DEPTH;
  const heights = Float32Array.from(known, (height) => (Number.isNaN(height) ? ofVoids : height));
  const isInside = (at) => !Number.isNaN(places.rows[2 * Math.floor(at / size) * n + 2 * (at % size)]);
  const holes = Uint8Array.from(known, (height, at) => Number.isNaN(height) && isInside(at));
  return { heights, holes: holes.includes(1) ? holes : null, ...errors };
}

/**
 * Return { known, places, error, terrainError }: size x size heights, single precision, NaN where void, at
 * every second of the places, of samples at most `spacing` metres apart; the places, as `Places.toSamples`
 * has them; the errors of `heightmap`.
 */
export async function sampledGrid(globe, lon, lat, size, spacing) {
  const n = 2 * size - 1;
  const places = globe.places.toSamples(lon, lat);
  const { heights: surface, window } = await globe.heightsAt(places, globe.levelFor(spacing));
  const known = new Float64Array(size * size);
  for (let i = 0; i < size; i++) {
    for (let j = 0; j < size; j++) known[i * size + j] = Math.fround(surface[2 * i * n + 2 * j]);
  }
  return {
    known,
    places,
    error: largestDistance(known, surface, n),
    terrainError: window === null ? null : await globe.heightsError(window),
  };
}
