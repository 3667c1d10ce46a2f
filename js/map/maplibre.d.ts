/** Tiles for MapLibre GL JS, made in the browser. */

import { PublishedTerrain, TileMaker } from "./tiles.js";

export { PublishedTerrain, TileMaker, publishedTerrains } from "./tiles.js";

export const SCHEME: "twz";

/** `maplibre` is the module, or what has its `addProtocol`. */
export function addTerrains(
  maplibre: { addProtocol(scheme: string, load: (...args: any[]) => Promise<{ data: any }>): void },
  terrains: PublishedTerrain[],
  maker?: TileMaker,
): TileMaker;

/** A raster-dem source for a style. */
export function demSource(terrain: PublishedTerrain, options?: { rim?: number }): {
  type: "raster-dem";
  encoding: "mapbox";
  tileSize: 256;
  tiles: string[];
  bounds: [number, number, number, number];
  maxzoom: number;
};
