/** MapLibre GL JS: a protocol whose tiles are made in the browser. */

import { TileMaker, publishedTerrains } from "./tiles.js";

export { TileMaker, publishedTerrains };

export const SCHEME = "twz";
const ADDRESS = /^twz:\/\/([^/?]+)\/(rgb|voids)\/(\d+)\/(\d+)\/(\d+)(?:\?(.*))?$/;

/**
 * Let maps use twz://NAME/rgb/{z}/{x}/{y} as a raster-dem source (encoding "mapbox", 256 pixels)
 * and twz://NAME/voids/{z}/{x}/{y}?color=dbe4e8 as a raster source that paints what is void.
 *
 * `?rim=4` lets heights go on beyond edges and into voids by 4 pixels, so that a surface has no
 * curtain there. `maplibre` is the module; `terrains` are those of `publishedTerrains`.
 */
export function addTerrains(maplibre, terrains, maker = new TileMaker()) {
  const byName = new Map(terrains.map((terrain) => [terrain.name, terrain]));
  maplibre.addProtocol(SCHEME, async ({ url }, { signal }) => {
    const found = ADDRESS.exec(url);
    const terrain = found && byName.get(decodeURIComponent(found[1]));
    if (!terrain) throw new Error(`${url}: there is no such terrain`);
    const [what, z, x, y] = [found[2], ...found.slice(3, 6).map(Number)];
    const told = new URLSearchParams(found[6]);
    const args = [z, x, y, Math.min(Number(told.get("rim")) || 0, 8)];
    if (what === "voids") {
      const color = parseInt(told.get("color") ?? "ffffff", 16);
      args.push([(color >> 16) & 255, (color >> 8) & 255, color & 255]);
    }
    const answer = await maker.ask(terrain, what, args, signal);
    return { data: answer?.image ?? null };
  });
  return maker;
}

/** Return a raster-dem source of a terrain, for a style. */
export function demSource({ name, described }, { rim = 4 } = {}) {
  const { bounds, maxzoom } = described;
  return {
    type: "raster-dem",
    encoding: "mapbox",
    tileSize: 256,
    tiles: [`${SCHEME}://${encodeURIComponent(name)}/rgb/{z}/{x}/{y}?rim=${rim}`],
    bounds: bounds[2] > 180 ? [-180, bounds[1], 180, bounds[3]] : bounds,
    maxzoom,
  };
}
