/** CesiumJS: a terrain provider whose height maps are made in the browser. */

import { meets } from "./heightmap.js";
import { TileMaker, publishedTerrains } from "./tiles.js";

export { TileMaker, publishedTerrains };

/** Heights along a tile's side. */
const SIZE = 65;
const MOST_ZOOM = 24;

/**
 * Return a TerrainProvider of a terrain of `publishedTerrains`. `Cesium` is the module.
 *
 * Its `tileErrors(z, x, y)` gives { error, terrainError } in metres of a tile that was made: how far
 * its surface is from that of the samples read, and how far originals can be from the latter. Voids,
 * and all beside the raster, lie 1 m below the lowest height.
 */
export function terrainProvider(Cesium, terrain, maker = new TileMaker()) {
  const { described } = terrain;
  const { axis, pixel } = described.placed;
  const ellipsoid = described.on_earth
    ? Cesium.Ellipsoid.WGS84 : new Cesium.Ellipsoid(axis, axis, described.placed.polar_axis);
  const tilingScheme = new Cesium.GeographicTilingScheme({ ellipsoid });
  const errorOfZero = Cesium.TerrainProvider.getEstimatedLevelZeroGeometricErrorForAHeightmap(
    ellipsoid, SIZE, tilingScheme.getNumberOfXTilesAtLevel(0),
  );
  const spacingOfZero = (Math.PI * axis) / (SIZE - 1);
  const lastZoom = Math.min(Math.max(Math.ceil(Math.log2(spacingOfZero / pixel)), 0), MOST_ZOOM);
  const isThere = (x, y, z) => z === 0 || (z <= lastZoom && meets(described.bounds, z, x, y));
  const errors = new Map();
  const credit = Object.values(described.origin).join(", ");

  async function makeTile(x, y, z) {
    const { heights, error, terrainError } = await maker.ask(terrain, "heightmap", [z, x, y, SIZE]);
    errors.set(`${z}/${x}/${y}`, { error, terrainError });
    let childTileMask = 0;
    // Bits as Cesium has them: south-west, south-east, north-west, north-east.
    [[0, 1], [1, 1], [0, 0], [1, 0]].forEach(([right, down], i) => {
      if (isThere(2 * x + right, 2 * y + down, z + 1)) childTileMask |= 1 << i;
    });
    return new Cesium.HeightmapTerrainData({
      buffer: heights, width: SIZE, height: SIZE, childTileMask,
    });
  }

  return {
    tilingScheme,
    errorEvent: new Cesium.Event(),
    credit: credit ? new Cesium.Credit(credit.replace(/[<>&]/g, " ")) : undefined,
    hasWaterMask: false,
    hasVertexNormals: false,
    availability: undefined,
    maximumLevel: lastZoom,
    requestTileGeometry: (x, y, z) => makeTile(x, y, z),
    getLevelMaximumGeometricError: (z) => errorOfZero / 2 ** z,
    getTileDataAvailable: isThere,
    loadTileDataAvailability: () => undefined,
    tileErrors: (z, x, y) => errors.get(`${z}/${x}/${y}`),
  };
}
