/** MapLibre GL JS: a protocol whose tiles are made in the browser. */

import { TileMaker, heldBounds, publishedTerrains } from "./tiles.js";

export { TileMaker, publishedTerrains };

export const SCHEME = "twz";
const ADDRESS = /^twz:\/\/([^/?]+)\/(rgb|voids)\/(\d+)\/(\d+)\/(\d+)(?:\?(.*))?$/;

/** { terrain, maker } of all calls of `addTerrains`, by URL and by name: a page has one protocol for all its maps. */
const added = new Map();

/**
 * Let maps use twz://TERRAIN/rgb/{z}/{x}/{y} as a raster-dem source (256 pixels; its encoding is the
 * terrain's own, that of `publish`, or what ?encoding=mapbox or terrarium asks for)
 * and twz://TERRAIN/voids/{z}/{x}/{y}?color=dbe4e8 as a raster source that paints what is void.
 *
 * TERRAIN is the terrain's URL or its name, as `encodeURIComponent` writes it. Terrains of earlier calls
 * stay; of two with the same name, the name means the later one. `?rim=4` lets heights go on beyond edges and into voids by 4 pixels, so that a surface has no
 * curtain there. `?voids=transparent` gives pixels without heights alpha 0. `maplibre` is the module; `terrains` are those of `publishedTerrains`.
 */
export function addTerrains(maplibre, terrains, maker = new TileMaker()) {
  for (const terrain of terrains) {
    for (const key of [terrain.name, String(terrain.url)]) added.set(key, { terrain, maker });
  }
  maplibre.addProtocol(SCHEME, tileOf);
  return maker;
}

/** Return { data } of the tile that a map asks for. */
async function tileOf({ url }, { signal }) {
  const found = ADDRESS.exec(url);
  const { terrain, maker } = (found && added.get(decodeURIComponent(found[1]))) ?? {};
  if (!terrain) throw new Error(`${url}: there is no such terrain`);
  const [what, z, x, y] = [found[2], ...found.slice(3, 6).map(Number)];
  const told = new URLSearchParams(found[6]);
  const args = [z, x, y, Math.min(Number(told.get("rim")) || 0, 8)];
  const encoding = told.get("encoding") ?? encodingOf(terrain);
  if (what === "voids") {
    const color = parseInt(told.get("color") ?? "ffffff", 16);
    args.push([(color >> 16) & 255, (color >> 8) & 255, color & 255]);
  }
  // Both kinds ask for the same: what one made, the other finds.
  args.push({ encoding, transparentVoids: told.get("voids") === "transparent", errors: false });
  const answer = await maker.ask(terrain, what, args, signal);
  return { data: answer?.image ?? null };
}

// Pages may describe a terrain without it.
const encodingOf = ({ described }) => described.encoding ?? "mapbox";

/** Return a raster-dem source of a terrain, for a style; by default in the terrain's encoding. */
export function demSource(terrain, { rim = 4, encoding = encodingOf(terrain) } = {}) {
  const { bounds, maxzoom } = terrain.described;
  const address = `${SCHEME}://${encodeURIComponent(String(terrain.url))}/rgb/{z}/{x}/{y}`;
  return {
    type: "raster-dem",
    encoding,
    tileSize: 256,
    tiles: [`${address}?rim=${rim}&encoding=${encoding}`],
    bounds: heldBounds(bounds),
    maxzoom,
  };
}
