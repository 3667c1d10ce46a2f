/** Files of a window of heights: an uncompressed GeoTIFF, or a PNG of 16 bits. */

import { storedNodata } from "./compare.js";

const SHORT = 3, LONG = 4, DOUBLE = 12, ASCII = 2;
const BYTES = { [ASCII]: 1, [SHORT]: 2, [LONG]: 4, [DOUBLE]: 8 };
const PUT = { [ASCII]: "setUint8", [SHORT]: "setUint16", [LONG]: "setUint32", [DOUBLE]: "setFloat64" };
const DEFLATED = "deflate";

/** Return the GeoKeys of a CRS AUTH:CODE, [] for others: GeoTIFFs name systems by their EPSG code. */
function geoKeysOf(crs, isGeographic) {
  const code = Number(/^EPSG:(\d+)$/.exec(crs ?? "")?.[1]);
  if (!(code > 0 && code < 65536)) return [];
  const keys = [[1024, isGeographic ? 2 : 1], [1025, 1], [isGeographic ? 2048 : 3072, code]];
  return [1, 1, 0, keys.length, ...keys.flatMap(([key, value]) => [key, 0, 1, value])];
}

/**
 * Return the value of voids in a file of heights: that of the terrain, or NaN, or the lowest one of integers that no
 * valid sample has; null, where there are neither voids nor a value of the terrain.
 */
function voidValue({ nodata, dtype }, { heights, valid }) {
  const isFloat = dtype.startsWith("float");
  if (nodata !== null && (isFloat || storedNodata(nodata, dtype) !== null)) return nodata;
  if (valid.every(Boolean)) return null;
  if (isFloat) return NaN;
  const taken = new Set(heights.filter((_, i) => valid[i]));
  const lowest = dtype.startsWith("u") ? 0 : -(2 ** (8 * heights.BYTES_PER_ELEMENT - 1));
  for (let k = 0; k < 2 ** (8 * heights.BYTES_PER_ELEMENT); k++) if (!taken.has(lowest + k)) return lowest + k;
  throw new Error(`the part has voids and every value of ${dtype}, so none can mark voids: save it as PNG`);
}

/**
 * Return { parts, nodata } of a GeoTIFF, little-endian, of what `Terrain.read` returned: what makes the file, and the
 * value of its voids, null without one.
 */
export function geoTiff(terrain, { heights, valid, nRows, nCols, level, row, col }, isGeographic) {
  const nodata = voidValue(terrain, { heights, valid });
  const filled = nodata === null ? heights : heights.map((height, i) => (valid[i] ? height : nodata));
  const bytes = heights.BYTES_PER_ELEMENT;
  const [a, b, c, d, e, f] = terrain.transform(level);
  const [x, y] = [a * col + b * row + c, d * col + e * row + f];
  const kind = terrain.dtype.startsWith("u") ? 1 : terrain.dtype.startsWith("f") ? 3 : 2;
  const item = (name, value) => `<Item name="${name.toUpperCase()}" sample="0" role="${name}">${value}</Item>`;
  const text = (value) => [...new TextEncoder().encode(value), 0];
  const isPacked = terrain.scale !== 1 || terrain.offset !== 0;
  const keys = geoKeysOf(terrain.crs, isGeographic);
  const tags = [
    [256, LONG, [nCols]], [257, LONG, [nRows]], [258, SHORT, [8 * bytes]], [259, SHORT, [1]], [262, SHORT, [1]],
    [273, LONG, [0]], [277, SHORT, [1]], [278, LONG, [nRows]], [279, LONG, [heights.byteLength]], [339, SHORT, [kind]],
    [34264, DOUBLE, [a, b, 0, x, d, e, 0, y, 0, 0, 0, 0, 0, 0, 0, 1]],
    ...(keys.length ? [[34735, SHORT, keys]] : []),
    ...(isPacked ? [[42112, ASCII, text(`<GDALMetadata>${item("scale", terrain.scale)}${item("offset", terrain.offset)}</GDALMetadata>`)]] : []),
    ...(nodata === null ? [] : [[42113, ASCII, text(`${nodata}`.toLowerCase().replace("infinity", "inf"))]]),
  ];
  const directory = 8;
  let end = directory + 2 + 12 * tags.length + 4;
  const placed = tags.map(([tag, type, values]) => {
    const size = BYTES[type] * values.length;
    const at = size > 4 ? end : null;
    if (at !== null) end += size + (size % 2);
    return { tag, type, values, at };
  });
  end += (8 - (end % 8)) % 8;
  placed.find(({ tag }) => tag === 273).values[0] = end;
  const view = new DataView(new ArrayBuffer(end));
  view.setUint32(0, 0x002a4949, true);
  view.setUint32(4, directory, true);
  view.setUint16(directory, tags.length, true);
  placed.forEach(({ tag, type, values, at }, i) => {
    const entry = directory + 2 + 12 * i;
    view.setUint16(entry, tag, true);
    view.setUint16(entry + 2, type, true);
    view.setUint32(entry + 4, values.length, true);
    if (at !== null) view.setUint32(entry + 8, at, true);
    values.forEach((value, k) => view[PUT[type]]((at ?? entry + 8) + k * BYTES[type], value, true));
  });
  return { parts: [view.buffer, filled], nodata };
}

/**
 * Return the parts of a PNG, grey of 16 bits: height = lowest + (code - 1) · step, 0 where void. The picture's
 * description says so. The step is 1 for whole numbers whose range fits, otherwise the range of heights / 65534.
 */
export async function png(terrain, { heights, valid, nRows, nCols }) {
  let [low, high] = [Infinity, -Infinity];
  for (let i = 0; i < heights.length; i++) {
    if (!valid[i]) continue;
    if (heights[i] < low) low = heights[i];
    if (heights[i] > high) high = heights[i];
  }
  const isWhole = !terrain.dtype.startsWith("f") && high - low <= 65534;
  const step = isWhole || !(high > low) ? 1 : (high - low) / 65534;
  const rows = new DataView(new ArrayBuffer(nRows * (2 * nCols + 1))); // a byte before each row: no filter
  for (let i = 0; i < heights.length; i++) {
    const at = Math.floor(i / nCols) * (2 * nCols + 1) + 1 + 2 * (i % nCols);
    rows.setUint16(at, valid[i] ? Math.round((heights[i] - low) / step) + 1 : 0);
  }
  const packed = new Blob([rows]).stream().pipeThrough(new CompressionStream(DEFLATED));
  const head = new DataView(new ArrayBuffer(13));
  head.setUint32(0, nCols);
  head.setUint32(4, nRows);
  head.setUint16(8, 0x1000); // 16 bits, grey
  const { scale, offset } = terrain;
  const told = high >= low ? `height = ${low * scale + offset} + (code - 1) * ${step * scale}; code 0: void` : "all void";
  return [
    Uint8Array.of(0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a), ...chunk("IHDR", head),
    ...chunk("tEXt", new TextEncoder().encode(`Description\0${told}`)),
    ...chunk("IDAT", await new Response(packed).arrayBuffer()), ...chunk("IEND", new ArrayBuffer(0)),
  ];
}

/** Return a chunk of a PNG: its length, its name, the data, their CRC-32. */
function chunk(name, data) {
  const bytes = ArrayBuffer.isView(data) ? new Uint8Array(data.buffer, data.byteOffset, data.byteLength) : new Uint8Array(data);
  const head = new DataView(new ArrayBuffer(8));
  const end = new DataView(new ArrayBuffer(4));
  head.setUint32(0, bytes.length);
  [...name].forEach((letter, i) => head.setUint8(4 + i, letter.charCodeAt(0)));
  end.setUint32(0, crc32(new Uint8Array(head.buffer, 4), bytes));
  return [head, bytes, end];
}

/** Return the CRC-32 of bytes, 0 … 2^32 - 1. */
export function crc32(...parts) {
  let crc = 0xffffffff;
  for (const part of parts) for (const byte of part) crc = CRC[(crc ^ byte) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

const CRC = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; k++) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
  return n;
});
