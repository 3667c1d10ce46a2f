// Tiles and heights made in the browser, of files that `terrainwave publish` put on a web server.
import { addProtocol } from "./maplibre/maplibre-gl.mjs";
import { SCHEME, addTerrains, publishedTerrains } from "../terrainwave/map/maplibre.js";

const terrains = new Map(
  (await publishedTerrains("terrains.json")).map((terrain) => [terrain.name, terrain]),
);
const maker = addTerrains({ addProtocol }, [...terrains.values()]);

/** Return the addresses of a terrain's tiles, "rgb" or "voids", for a style. */
export function tilesOf({ name }, kind, query) {
  return [`${SCHEME}://${encodeURIComponent(name)}/${kind}/{z}/{x}/{y}?${query}`];
}

/** Return { height, max_error } at a place. */
export function heightAt({ name }, { lng, lat }, signal) {
  return maker.ask(terrains.get(name), "height", [lng, lat], signal);
}

/** Return [what it is for, address] of all that can be had of a terrain. */
export function addressesOf({ name }) {
  return [
    ["The file: terrainwave.open", terrains.get(name).url.href],
    ["Module: MapLibre", new URL("terrainwave/map/maplibre.js", document.baseURI).href],
    ["Module: CesiumJS", new URL("terrainwave/map/cesium.js", document.baseURI).href],
  ];
}
