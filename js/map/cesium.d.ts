/** Terrain for CesiumJS, made in the browser. */

import { PublishedTerrain, TileErrors, TileMaker } from "./tiles.js";

export { PublishedTerrain, TileErrors, TileMaker, publishedTerrains } from "./tiles.js";

/** A TerrainProvider; `Cesium` is the module. */
export function terrainProvider(
  Cesium: any,
  terrain: PublishedTerrain,
  maker?: TileMaker,
): any & { tileErrors(z: number, x: number, y: number): TileErrors | undefined };
