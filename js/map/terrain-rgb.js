/**
 * Terrain-RGB tiles in Web Mercator, made of a terrain: those of `terrainwave serve`.
 *
 * mapbox: height = -10000 + (R * 65536 + G * 256 + B) * 0.1 (Mapbox Terrain-RGB v1)
 * terrarium: height = -32768 + R * 256 + G + B / 256 (Mapzen Terrarium)
 */

import { everySecond, growInto, largestDistance, shareOfVoids, without } from "./surfaces.js";

export const TILE_SIZE = 256;
/** Voids lie this many metres below the terrain's lowest height: the format has none. */
export const VOID_DEPTH = 1;
const MAX_LATITUDE = (Math.atan(Math.sinh(Math.PI)) * 180) / Math.PI;
/** Encodings of heights in pixels, metres: that of code 0, and from one code to the next. */
export const ENCODINGS = {
  mapbox: { lowest: -10000, step: 0.1 },
  terrarium: { lowest: -32768, step: 1 / 256 },
};
const HIGHEST_CODE = 2 ** 24 - 1;

export const longitudeOf = (z, x) => (x / 2 ** z) * 360 - 180;
export const latitudeOf = (z, y) =>
  (Math.atan(Math.sinh(Math.PI * (1 - (2 * y) / 2 ** z))) * 180) / Math.PI;

/** Return metres between places of a tile of which n lie on its side, in its middle. */
export function spacingOf(globe, z, y, n) {
  const [, south, , north] = globe.extent;
  const held = (latitude, low, high) => Math.min(Math.max(latitude, low), high);
  const latitude = held(held(latitudeOf(z, y + 0.5), south, north), -MAX_LATITUDE, MAX_LATITUDE);
  const around = 2 * Math.PI * globe.axis * Math.cos((latitude * Math.PI) / 180);
  return around / (n * 2 ** z);
}

function codeOf(height, { lowest, step }) {
  const code = (height - lowest) / step;
  const whole = Math.round(code);
  // Halves to even, as Python rounds.
  const even = Math.abs(whole - code) === 0.5 && whole % 2 !== 0 ? whole - 1 : whole;
  return Math.min(Math.max(even, 0), HIGHEST_CODE);
}

/**
 * Return the tile z/x/y (XYZ): { pixels, voids, error, terrainError, level }.
 *
 * `pixels` are RGBA; `voids` says how much of each pixel is void, 0 … 255. In metres, `error`: how
 * far the tile's bilinear surface is from that of the samples, at pixels and halfway between them;
 * `terrainError`: how far originals can be from the latter. By `rim` pixels heights go on into voids
 * and beyond edges, which is not in `error`. With `transparentVoids`, pixels without heights have
 * alpha 0. null where there is no terrain.
 */
export async function rgbTile(globe, z, x, y, rim = 0, look = {}) {
  const encoding = encodingOf(look);
  const surface = await fineSurface(globe, z, x, y, rim);
  if (surface === null) return null;
  const { heights, n, level, window } = surface;
  const nPixels = TILE_SIZE + 2 * rim;
  const centres = everySecond(heights, n);
  const pixels = drawn(globe, centres, rim, look);
  if (pixels === null) return null;
  const inner = without(centres, nPixels, rim);
  const { lowest, step } = encoding;
  const codes = Float64Array.from(inner, (height) => codeOf(height, encoding) * step + lowest);
  return {
    pixels,
    voids: shareOfVoids(heights, n, rim),
    error: largestDistance(codes, without(heights, n, 2 * rim), n - 4 * rim),
    terrainError: await globe.heightsError(window),
    level,
  };
}

/**
 * Return { pixels, isWhole } of a tile, those of `rgbTile`, in a quarter of the time; null where there is no
 * terrain. `isWhole`: nothing is void, not even between pixels.
 */
export async function rgbPixels(globe, z, x, y, rim = 0, look = {}) {
  const surface = await surfaceAt(globe, z, x, y, rim, 1);
  const pixels = surface && drawn(globe, surface.heights, rim, look);
  const isWhole = () => !surface.heights.some(Number.isNaN)
    && surface.window.parts.every(({ valid }) => !valid.includes(0));
  return pixels && { pixels, isWhole: isWhole() };
}

/** Return the voids of `rgbTile`. */
export async function voidsOf(globe, z, x, y, rim = 0) {
  const surface = await fineSurface(globe, z, x, y, rim);
  return shareOfVoids(surface.heights, surface.n, rim);
}

/** Return the heights of pixel centres, and of places halfway between them, which errors are taken at. */
function fineSurface(globe, z, x, y, rim) {
  return surfaceAt(globe, z, x, y, rim, 2);
}

/** Return { heights, n, level, window }: n x n heights, `times` in a pixel's width; null where nothing is. */
async function surfaceAt(globe, z, x, y, rim, times) {
  const level = globe.levelFor(spacingOf(globe, z, y, TILE_SIZE));
  const n = times * (TILE_SIZE + 2 * rim) - times + 1;
  const at = Array.from({ length: n }, (_, i) => (i / times + 0.5 - rim) / TILE_SIZE);
  const lon = at.map((place) => longitudeOf(z, x + place));
  const lat = at.map((place) => latitudeOf(z, y + place));
  const { heights, window } = await globe.heightsAt(globe.places.toSamples(lon, lat), level);
  return window && { heights, n, level, window };
}

/** Return the pixels of heights at the centres of pixels, with a rim; null where nothing is within it. */
function drawn(globe, centres, rim, look) {
  const nPixels = TILE_SIZE + 2 * rim;
  const heights = without(growInto(centres, nPixels, rim), nPixels, rim);
  return heights.every(Number.isNaN) ? null : encode(globe, heights, look);
}

/** Return the pixels of a tile without terrain. */
export function voidPixels(globe, look = {}) {
  return encode(globe, new Float64Array(TILE_SIZE * TILE_SIZE).fill(NaN), look);
}

function encodingOf({ encoding = "mapbox" }) {
  if (!Object.hasOwn(ENCODINGS, encoding)) {
    throw new Error(`found encoding ${encoding}, expected ${Object.keys(ENCODINGS).join(" or ")}`);
  }
  return ENCODINGS[encoding];
}

function encode(globe, heights, look) {
  const encoding = encodingOf(look);
  const pixels = new Uint8ClampedArray(4 * heights.length);
  const ofVoids = codeOf(globe.lowest - VOID_DEPTH, encoding);
  const opacityOfVoids = look.transparentVoids ? 0 : 255;
  heights.forEach((height, i) => {
    const isVoid = Number.isNaN(height);
    const code = isVoid ? ofVoids : codeOf(height, encoding);
    pixels[4 * i] = code >> 16;
    pixels[4 * i + 1] = (code >> 8) & 255;
    pixels[4 * i + 2] = code & 255;
    pixels[4 * i + 3] = isVoid ? opacityOfVoids : 255;
  });
  return pixels;
}
