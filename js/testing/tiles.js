/**
 * Print tiles of a published folder, as JSON: node testing/tiles.js FOLDER NAME RIM rgb/Z/X/Y …
 *
 * terrarium/Z/X/Y has that encoding, and transparent voids.
 */

import { readFile } from "node:fs/promises";

import { Globe } from "../map/globe.js";
import { heightmap } from "../map/heightmap.js";
import { rgbTile } from "../map/terrain-rgb.js";
import { open } from "../src/index.js";

const [folder, name, rim, ...places] = process.argv.slice(2);
const terrains = JSON.parse(await readFile(`${folder}/terrains.json`));
const described = terrains.find((one) => one.name === name);
const globe = new Globe(await open(await readFile(`${folder}/${described.file}`)), described);
const text = (array) => Buffer.from(array.buffer, array.byteOffset, array.byteLength).toString("base64");

const found = {};
for (const place of places) {
  const [kind, ...numbers] = place.split("/");
  const at = numbers.map(Number);
  const look = kind === "terrarium" ? { encoding: kind, transparentVoids: true } : {};
  const tile = kind === "map"
    ? await heightmap(globe, ...at, 65) : await rgbTile(globe, ...at, Number(rim), look);
  for (const array of ["pixels", "voids", "heights"]) {
    if (tile?.[array]) tile[array] = text(tile[array]);
  }
  found[place] = tile;
}
console.log(JSON.stringify(found));
