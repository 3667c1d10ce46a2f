/** Makes tiles in a thread of its own: messages { id, terrain, what, args } are answered by id. */

// Imports of the modules below, the largest first: all comes at once, not one after another.
import "../src/core-data.js";
import "../src/url.js";
import "../src/terrain.js";
import "../src/core.js";
import "../src/workers.js";
import "../src/source.js";
import "../src/blocks.js";
import "../src/engine.js";
import "../src/module.js";
import "../src/mailbox.js";
import "../src/errors.js";
import "./places.js";
import "./surfaces.js";
import { open } from "../src/index.js";
import { Mailbox, answer } from "../src/mailbox.js";
import { Globe } from "./globe.js";
import { heightmap, sampledRectangle } from "./heightmap.js";
import { gridMesh } from "./mesh.js";
import {
  TILE_SIZE, latitudeOf, longitudeOf, rgbPixels, rgbTile, spacingOf, voidPixels, voidsOf,
} from "./terrain-rgb.js";

const N_KEPT = 32;
const globes = new Map(); // by `keyOf`: promises
const brought = new Map(); // by name: sources whose bytes the page brings

function bring({ name, size, port }) {
  const mailbox = new Mailbox(port);
  port.onmessage = ({ data }) => mailbox.settle(data);
  brought.set(name, { size, read: async (start, end) => (await mailbox.ask({ start, end }))[0] });
}

/** Terrains of two folders may have the same name. */
const keyOf = ({ name, url }) => (brought.has(name) ? name : url);

function openGlobe(terrain) {
  const key = keyOf(terrain);
  if (!globes.has(key)) {
    const { url, described } = terrain;
    const opened = open(brought.get(key) ?? url, { blocks: true }).then((file) => new Globe(file, described));
    globes.set(key, opened);
    opened.catch(() => globes.delete(key)); // another try opens it anew
  }
  return globes.get(key);
}

/** The newest answers, by place: heights and voids of a tile are asked for apart. */
const made = new Map();

function madeOnce(make, key, globe, ...args) {
  const place = JSON.stringify([make.name, key, ...args]);
  const found = made.get(place) ?? make(globe, ...args);
  made.delete(place);
  made.set(place, found);
  found.catch(() => made.delete(place));
  for (const oldest of made.keys()) {
    if (made.size <= N_KEPT) break;
    made.delete(oldest);
  }
  return found;
}

/** Return a picture and what must not be changed by whoever shows it. */
function picture(pixels) {
  const data = new ImageData(pixels, TILE_SIZE, TILE_SIZE);
  return createImageBitmap(data, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}

const WORK = {
  /** `look.errors`, unless false: with errors, which take three quarters of the time. */
  async rgb(globe, key, z, x, y, rim, { errors = true, ...look } = {}) {
    const tile = await madeOnce(errors ? rgbTile : rgbPixels, key, globe, z, x, y, rim, look);
    if (tile === null && rim === 0) return null;
    const { error = null, terrainError = null } = tile ?? {};
    return { image: await picture(tile?.pixels ?? voidPixels(globe, look)), error, terrainError };
  },
  async voids(globe, key, z, x, y, rim, color, { errors: _, ...look } = {}) {
    const tile = await madeOnce(rgbPixels, key, globe, z, x, y, rim, look);
    if (tile?.isWhole) return null;
    const voids = tile && await voidsOf(globe, z, x, y, rim);
    if (voids && !voids.some((share) => share)) return null;
    const pixels = new Uint8ClampedArray(4 * TILE_SIZE ** 2);
    for (let i = 0; i < TILE_SIZE ** 2; i++) {
      pixels.set(color, 4 * i);
      pixels[4 * i + 3] = voids ? voids[i] : 255;
    }
    return { image: await picture(pixels) };
  },
  heightmap: (globe, _key, ...tile) => heightmap(globe, ...tile),
  /** Heights at pixels of a rectangle of the Web Mercator world, 0 to 1 across and down, and metres of a pixel. */
  async plan(globe, _key, [left, top, right, bottom], nCols, nRows) {
    const between = (first, last, n) =>
      Array.from({ length: n }, (_, i) => first + ((last - first) * (i + 0.5)) / n);
    const lon = between(left, right, nCols).map((x) => longitudeOf(0, x));
    const lat = between(top, bottom, nRows).map((y) => latitudeOf(0, y));
    const spacing = spacingOf(globe, 0, (top + bottom) / 2 - 0.5, nCols / (right - left));
    const { heights } = await globe.heightsAt(globe.places.toSamples(lon, lat), globe.levelFor(spacing));
    return { heights, spacing };
  },
  mesh: (globe, _key, ...tile) => gridMesh(globe, ...tile),
  /** n x n heights of a part of the map, [west, south, east, north], and their errors as `heightmap` has them. */
  async surface(globe, _key, bounds, n) {
    const { known, error, terrainError } = await sampledRectangle(globe, bounds, n);
    return { known, error, terrainError };
  },
  async height(globe, _key, lon, lat) {
    const { heights } = await globe.heightsAt(globe.places.toSamples([lon], [lat]), globe.kMax);
    const height = Number.isNaN(heights[0]) ? null : heights[0];
    return { lon, lat, height, max_error: globe.error };
  },
};

self.onmessage = ({ data }) => {
  const { id, terrain, what, args } = data;
  if (data.brought) bring(data.brought);
  else answer(self, id, async () => WORK[what](await openGlobe(terrain), keyOf(terrain), ...args));
};
