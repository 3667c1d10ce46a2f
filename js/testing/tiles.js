/**
 * Print tiles of a published folder, as JSON: node testing/tiles.js FOLDER NAME RIM rgb/Z/X/Y …
 *
 * terrarium/Z/X/Y has that encoding, and transparent voids. What is made without errors, in less time,
 * must be the same.
 */

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";

import { Globe } from "../map/globe.js";
import { heightmap } from "../map/heightmap.js";
import { rgbPixels, rgbTile, voidsOf } from "../map/terrain-rgb.js";
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
  if (tile && kind !== "map") {
    const quick = await rgbPixels(globe, ...at, Number(rim), look);
    assert.deepEqual(quick.pixels, tile.pixels);
    assert.deepEqual(await voidsOf(globe, ...at, Number(rim)), tile.voids);
    assert.ok(!quick.isWhole || tile.voids.every((share) => share === 0));
    tile.isWhole = quick.isWhole;
  }
  for (const array of ["pixels", "voids", "heights", "holes"]) {
    if (tile?.[array]) tile[array] = text(tile[array]);
  }
  found[place] = tile;
}
console.log(JSON.stringify(found));
