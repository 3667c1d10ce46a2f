// Tiles and heights made in the browser, of files that `terrainwave publish` put on a web server.
//
// The page of a published folder runs this before MapLibre has come: meanwhile the worker opens the file.
import * as making from "./making.js";
import * as permalink from "./permalink.js";
import { showStill } from "./still.js";
import { terrains as listed } from "./terrains.js";
import { TileMaker } from "../terrainwave/map/maplibre.js";

const maker = new TileMaker();
const terrains = (await listed).map((described) => {
  const { name, file } = described;
  return { name, url: new URL(file, document.baseURI), described };
});
const told = permalink.read(location.hash);
const first = terrains.find(({ name }) => name === told.terrain) ?? terrains[0];
showStill(maker, first, told).catch(() => {}); // whoever wants a tile is told

/** Return what tiles and heights of the listed terrains come from. */
export const open = (maplibre) => making.open(maplibre, terrains, maker);
