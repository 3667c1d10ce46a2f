// Tiles and heights made in the browser, of files that `terrainwave publish` put on a web server.
//
// The page of a published folder runs this before MapLibre has come: meanwhile the worker opens the file.
import * as permalink from "./permalink.mjs";
import { terrains as listed } from "./terrains.mjs";
import { SCHEME, TileMaker, addTerrains } from "../terrainwave/map/maplibre.js";

const maker = new TileMaker();
const terrains = new Map((await listed).map((described) => {
  const { name, file } = described;
  return [name, { name, url: new URL(file, document.baseURI), described }];
}));
const first = terrains.get(permalink.read(location.hash).terrain) ?? terrains.values().next().value;
maker.ask(first, "open", []).catch(() => {}); // whoever wants a tile is told

/** Let a map use the tiles. */
export function connect(maplibre) {
  addTerrains(maplibre, [...terrains.values()], maker);
}

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
