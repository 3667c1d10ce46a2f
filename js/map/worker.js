/** Makes tiles in a thread of its own: messages { id, terrain, what, args } are answered by id. */

import { open } from "../src/index.js";
import { Mailbox } from "../src/mailbox.js";
import { Globe } from "./globe.js";
import { heightmap } from "./heightmap.js";
import { TILE_SIZE, rgbTile, voidPixels } from "./terrain-rgb.js";

const N_KEPT = 32;
const globes = new Map(); // by name: promises
const brought = new Map(); // by name: sources whose bytes the page brings

function bring({ name, size, port }) {
  const mailbox = new Mailbox(({ message }) => new Error(message));
  port.onmessage = ({ data }) => mailbox.settle(data);
  const read = (start, end) => {
    const { id, answer } = mailbox.ask(null);
    port.postMessage({ id, start, end });
    return answer;
  };
  brought.set(name, { size, read });
}

function openGlobe({ name, url, described }) {
  if (!globes.has(name)) {
    const opened = open(brought.get(name) ?? url, { blocks: true }).then((terrain) => new Globe(terrain, described));
    globes.set(name, opened);
    opened.catch(() => globes.delete(name)); // another try opens it anew
  }
  return globes.get(name);
}

/** The tiles asked for last, by place: heights and voids of one are asked for apart. */
const tiles = new Map();

function tileOf(name, globe, z, x, y, rim, look = {}) {
  const { encoding = "mapbox", transparentVoids = false } = look;
  const place = [name, z, x, y, rim, encoding, transparentVoids].join("/");
  const found = tiles.get(place) ?? rgbTile(globe, z, x, y, rim, look);
  tiles.delete(place);
  tiles.set(place, found);
  found.catch(() => tiles.delete(place));
  for (const oldest of tiles.keys()) {
    if (tiles.size <= N_KEPT) break;
    tiles.delete(oldest);
  }
  return found;
}

/** Return a picture and what must not be changed by whoever shows it. */
function picture(pixels) {
  const data = new ImageData(pixels, TILE_SIZE, TILE_SIZE);
  return createImageBitmap(data, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}

const WORK = {
  async rgb(globe, name, z, x, y, rim, look) {
    const tile = await tileOf(name, globe, z, x, y, rim, look);
    if (tile === null && rim === 0) return null;
    const { error = null, terrainError = null } = tile ?? {};
    return { image: await picture(tile?.pixels ?? voidPixels(globe, look)), error, terrainError };
  },
  async voids(globe, name, z, x, y, rim, color, look) {
    const tile = await tileOf(name, globe, z, x, y, rim, look);
    if (tile !== null && !tile.voids.some((share) => share)) return null;
    const pixels = new Uint8ClampedArray(4 * TILE_SIZE ** 2);
    for (let i = 0; i < TILE_SIZE ** 2; i++) {
      pixels.set(color, 4 * i);
      pixels[4 * i + 3] = tile === null ? 255 : tile.voids[i];
    }
    return { image: await picture(pixels) };
  },
  async heightmap(globe, name, z, x, y, size) {
    return heightmap(globe, z, x, y, size);
  },
  async height(globe, name, lon, lat) {
    const { heights } = await globe.heightsAt(globe.places.toSamples([lon], [lat]), globe.kMax);
    const height = Number.isNaN(heights[0]) ? null : heights[0];
    return { lon, lat, height, max_error: globe.error };
  },
};

self.onmessage = async ({ data }) => {
  const { id, terrain, what, args } = data;
  if (data.brought) {
    bring(data.brought);
    return;
  }
  try {
    const globe = await openGlobe(terrain);
    const found = await WORK[what](globe, terrain.name, ...args);
    const moved = [found?.image, found?.heights?.buffer].filter(Boolean);
    self.postMessage({ id, found }, moved);
  } catch (error) {
    self.postMessage({ id, error: { name: error.name, message: error.message } });
  }
};
