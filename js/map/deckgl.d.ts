/** Terrain for deck.gl, made in the browser. */

import { PublishedTerrain, TileMaker } from "./tiles.js";

export { PublishedTerrain, TileMaker, publishedTerrains } from "./tiles.js";

/** Properties of a TerrainLayer. */
export function terrainLayerProps(
  terrain: PublishedTerrain,
  maker?: TileMaker,
): {
  elevationData: string;
  tileSize: number;
  minZoom: number;
  maxZoom: number;
  extent: [number, number, number, number];
  fetch(url: string, about: any): Promise<any>;
};
