/** Tiles for MapLibre GL JS, made in the browser. */

import { Encoding, PublishedTerrain, TileMaker } from "./tiles.js";

export { Encoding, PublishedTerrain, TileMaker, publishedTerrains } from "./tiles.js";

export const SCHEME: "twz";

/** `maplibre` is the module, or what has its `addProtocol`. */
export function addTerrains(
  maplibre: { addProtocol(scheme: string, load: (...args: any[]) => Promise<{ data: any }>): void },
  terrains: PublishedTerrain[],
  maker?: TileMaker,
): TileMaker;

/** A raster-dem source for a style. */
export function demSource(
  terrain: PublishedTerrain,
  options?: { rim?: number; encoding?: Encoding },
): {
  type: "raster-dem";
  encoding: Encoding;
  tileSize: 256;
  tiles: string[];
  bounds: [number, number, number, number];
  maxzoom: number;
};
