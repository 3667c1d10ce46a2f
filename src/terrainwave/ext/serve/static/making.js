// Tiles and heights made in the browser, of files that a source is known of.
import { SCHEME, addTerrains } from "../terrainwave/map/maplibre.js";

/** Return what tiles and heights of terrains come from; `maplibre` is the module, `maker` makes them. */
export function open(maplibre, terrains, maker) {
  const byName = new Map(terrains.map((terrain) => [terrain.name, terrain]));
  addTerrains(maplibre, terrains, maker);
  return {
    maker,
    byName,

    /** Take another terrain, { name, url, described }; `bytes` is a source of the page, for one without a URL. */
    add(terrain, bytes) {
      byName.set(terrain.name, terrain);
      addTerrains(maplibre, [terrain], maker);
      if (bytes) maker.bring(terrain.name, bytes);
    },

    /** Return the addresses of a terrain's tiles, "rgb" or "voids", for a style. */
    tilesOf: ({ name }, kind, query) =>
      [`${SCHEME}://${encodeURIComponent(name)}/${kind}/{z}/{x}/{y}?${query}`],

    /** Return { height, max_error } at a place. */
    heightAt: ({ name }, { lng, lat }, signal) =>
      maker.ask(byName.get(name), "height", [lng, lat], signal),

    /** Return [what it is for, address] of all that can be had of a terrain. */
    addressesOf: ({ name }) => [
      // A file of the page's visitor has none.
      ...(byName.get(name).url ? [["The file: terrainwave.open", byName.get(name).url.href]] : []),
      ["Module: MapLibre", new URL("terrainwave/map/maplibre.js", document.baseURI).href],
      ["Module: CesiumJS", new URL("terrainwave/map/cesium.js", document.baseURI).href],
    ],
  };
}
