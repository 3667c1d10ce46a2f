/** Height maps of tiles in longitude and latitude (TMS as Cesium counts: rows from the north). */

import { VOID_DEPTH } from "./terrain-rgb.js";
import { everySecond, largestDistance } from "./surfaces.js";

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
  const { known, places, ...errors } = await sampledRectangle(globe, rectangleOf(z, x, y), size);
  const n = 2 * size - 1;
  const ofVoids = globe.lowest - VOID_DEPTH;
  const heights = Float32Array.from(known, (height) => (Number.isNaN(height) ? ofVoids : height));
  const isInside = (at) => !Number.isNaN(places.rows[2 * Math.floor(at / size) * n + 2 * (at % size)]);
  const holes = Uint8Array.from(known, (height, at) => Number.isNaN(height) && isInside(at));
  return { heights, holes: holes.includes(1) ? holes : null, ...errors };
}

/** Return what `sampledGrid` returns of a rectangle of longitudes and latitudes, whose edges have the outer heights. */
export function sampledRectangle(globe, [west, south, east, north], size) {
  const share = Array.from({ length: 2 * size - 1 }, (_, i) => i / (2 * size - 2));
  const spacing = ((north - south) / (size - 1) / 180) * Math.PI * globe.axis;
  return sampledGrid(
    globe, share.map((at) => west + at * (east - west)), share.map((at) => north - at * (north - south)), size, spacing,
  );
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
  const known = everySecond(surface, n).map(Math.fround);
  return {
    known,
    places,
    error: largestDistance(known, surface, n),
    terrainError: window === null ? null : await globe.heightsError(window),
  };
}
