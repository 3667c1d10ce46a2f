/** deck.gl: a TerrainLayer whose meshes are made in the browser. */

import { TileMaker, heldBounds, publishedTerrains } from "./tiles.js";

export { TileMaker, publishedTerrains };

/** Vertices along a tile's side: one at each second pixel, as MapLibre has them. */
const SIZE = 129;
const TILE = /^twz:\/\/mesh\/(\d+)\/(\d+)\/(\d+)$/;

/**
 * Return properties of a TerrainLayer that shows a terrain of `publishedTerrains`:
 * `new TerrainLayer({ id: "dem", ...terrainLayerProps(terrain), color: [207, 200, 184] })`.
 *
 * `texture` is a template of images, as in any other TerrainLayer. `meshMaxError` and `elevationDecoder` mean nothing:
 * a mesh has a vertex at each second pixel, and no steps. deck.gl keeps places of such layers in single
 * precision: about 2 m.
 */
export function terrainLayerProps(terrain, maker = new TileMaker()) {
  const { bounds, maxzoom } = terrain.described;
  return {
    elevationData: "twz://mesh/{z}/{x}/{y}",
    tileSize: 256,
    minZoom: 0,
    maxZoom: maxzoom + 1,
    extent: heldBounds(bounds),
    // deck.gl calls it instead of its loaders, and makes no request of its own then.
    async fetch(url, { signal }) {
      const place = TILE.exec(url)?.slice(1).map(Number);
      if (!place) return createImageBitmap(await (await globalThis.fetch(url, { signal })).blob());
      return meshOf(await maker.ask(terrain, "mesh", [...place, SIZE], signal));
    },
  };
}

/** Return a mesh as loaders.gl has it. */
function meshOf({ positions, normals, places, indices, lowest, highest }) {
  const [left, bottom] = positions.subarray(3 * (SIZE * SIZE - SIZE));
  const [right, top] = positions.subarray(3 * (SIZE - 1));
  return {
    loaderData: { header: {} },
    header: { vertexCount: indices.length, boundingBox: [[left, bottom, lowest], [right, top, highest]] },
    mode: 4, // triangles
    // A mesh without any would be none: tiles beside the terrain have a triangle that nobody sees.
    indices: { value: indices.length ? indices : new Uint32Array(3), size: 1 },
    attributes: {
      POSITION: { value: positions, size: 3 },
      NORMAL: { value: normals, size: 3 },
      TEXCOORD_0: { value: places, size: 2 },
    },
  };
}
