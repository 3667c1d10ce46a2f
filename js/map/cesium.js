/** CesiumJS: a terrain provider whose height maps are made in the browser. */

import { meets, rectangleOf } from "./heightmap.js";
import { TileMaker, publishedTerrains } from "./tiles.js";

export { TileMaker, publishedTerrains };

/** Heights along a tile's side. */
const SIZE = 65;
const MOST_ZOOM = 24;
/** Of a tile's width, height, and range of heights, in Cesium's meshes. */
const STEPS = 32767;

/**
 * Return a TerrainProvider of a terrain of `publishedTerrains`. `Cesium` is the module.
 *
 * Its `tileErrors(z, x, y)` gives { error, terrainError } in metres of a tile that was made: how far
 * its surface is from that of the samples read, and how far originals can be from the latter. Voids are
 * holes; all beside the raster lies 1 m below the lowest height.
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
    const { heights, holes, error, terrainError } = await maker.ask(terrain, "heightmap", [z, x, y, SIZE]);
    let childTileMask = 0;
    // Bits as Cesium has them: south-west, south-east, north-west, north-east.
    [[0, 1], [1, 1], [0, 0], [1, 0]].forEach(([right, down], i) => {
      if (isThere(2 * x + right, 2 * y + down, z + 1)) childTileMask |= 1 << i;
    });
    const about = { childTileMask, createdByUpsampling: z > lastZoom };
    if (!holes) {
      errors.set(`${z}/${x}/${y}`, { error, terrainError });
      return new Cesium.HeightmapTerrainData({ buffer: heights, width: SIZE, height: SIZE, ...about });
    }
    const skirt = 5 * (errorOfZero / 2 ** z); // as Cesium has it
    const mesh = meshWithHoles(Cesium, ellipsoid, rectangleOf(z, x, y), { heights, holes, skirt });
    errors.set(`${z}/${x}/${y}`, { error: error + mesh.rounding, terrainError });
    const data = new Cesium.QuantizedMeshTerrainData({ ...mesh, ...about });
    // Cesium makes finer tiles of a mesh's triangles: inside a hole, of none, it would try for ever.
    data.upsample = (_scheme, _x, _y, _z, finerX, finerY, finerZ) => makeTile(finerX, finerY, finerZ);
    return data;
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

/**
 * Return a tile's height map as options of QuantizedMeshTerrainData, without the cells that have a void
 * corner, and by how many metres its heights are rounded.
 */
function meshWithHoles(Cesium, ellipsoid, [west, south, east, north], { heights, holes, skirt }) {
  const known = heights.filter((_, at) => !holes[at]);
  const [low, high] = known.length ? [Math.min(...known), Math.max(...known)] : [heights[0], heights[0]];
  const n = SIZE * SIZE;
  const quantizedVertices = new Uint16Array(3 * n);
  const points = [];
  const indices = [];
  for (let at = 0; at < n; at++) {
    const [i, j] = [Math.floor(at / SIZE), at % SIZE];
    const [u, v] = [j / (SIZE - 1), 1 - i / (SIZE - 1)];
    const height = holes[at] ? low : heights[at];
    quantizedVertices[at] = Math.round(u * STEPS);
    quantizedVertices[n + at] = Math.round(v * STEPS);
    quantizedVertices[2 * n + at] = Math.round(((height - low) / (high - low || 1)) * STEPS);
    points.push(Cesium.Cartesian3.fromDegrees(
      west + u * (east - west), south + v * (north - south), height, ellipsoid,
    ));
    const cell = [at, at + SIZE, at + 1, at + SIZE + 1];
    if (i === SIZE - 1 || j === SIZE - 1 || cell.some((corner) => holes[corner])) continue;
    indices.push(cell[0], cell[1], cell[2], cell[2], cell[1], cell[3]);
  }
  const boundingSphere = Cesium.BoundingSphere.fromPoints(points);
  const side = (first, step) => Array.from({ length: SIZE }, (_, k) => first + k * step).filter((at) => !holes[at]);
  return {
    rounding: (high - low) / STEPS / 2,
    quantizedVertices,
    indices: Uint16Array.from(indices.length ? indices : [0, 0, 0]), // a mesh of nothing would be none
    minimumHeight: low,
    maximumHeight: high,
    boundingSphere,
    horizonOcclusionPoint: new Cesium.EllipsoidalOccluder(ellipsoid)
      .computeHorizonCullingPointPossiblyUnderEllipsoid(boundingSphere.center, points, low),
    westIndices: side(n - SIZE, -SIZE),
    southIndices: side(n - SIZE, 1),
    eastIndices: side(n - 1, -SIZE),
    northIndices: side(0, 1),
    westSkirtHeight: skirt,
    southSkirtHeight: skirt,
    eastSkirtHeight: skirt,
    northSkirtHeight: skirt,
  };
}
