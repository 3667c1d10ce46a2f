/** A band of a GeoTIFF, as `terrainwave verify` reads it: heights, and which of them are valid. */

import { fromBlob } from "./geotiff/geotiff.js";
import { storedNodata } from "./compare.js";
import { METRES } from "./described.js";

const KINDS = { 1: "uint", 2: "int", 3: "float" };
/** Of ExtraSamples: what GDAL takes for alpha. */
const ALPHAS = [1, 2];
const CHOOSE = "choose the raster that the file was made from";
const IS_MASK = 4; // of NewSubfileType
const IS_POINT = 2; // of GTRasterTypeGeoKey
const SIZES = [8, 16, 32, 64];
/** Rows of an uncompressed strip that are read at once, and bytes of another strip or tile, which is decoded as a whole. */
const [ROWS_AT_ONCE, MOST_DECODED] = [512, 100 * 2 ** 20];
/** Names of Compression that geotiff.js reads as GDAL writes them. */
const COMPRESSIONS = { 1: "none", 5: "LZW", 8: "deflate", 32946: "deflate", 32773: "PackBits", 50000: "ZSTD" };
const TAGS = { StripOffsets: 273, RowsPerStrip: 278, StripByteCounts: 279 };
const NO_UNIT = /^(|unspecified|unknown|undefined|none|n\/a|-)$/i;
/** CRSs without a vertical axis, which would give the heights a unit: they are named by a code, or a WKT in full. */
const IS_FLAT = /^(EPSG:(4326|3857|2\d{3}|3[0-7]\d{2}|2[1-9]\d{3}|3[0-2]\d{3})|(?!.*(VERT|\bup\b)).*\[.*)$/is;

export class Original {
  #image;
  #mask = null;

  /** Open a File or Blob; `band` counts from 1. */
  static async open(file, band = 1) {
    const magic = new Uint8Array(await file.slice(0, 4).arrayBuffer());
    const isTiff = ["II*\0", "MM\0*", "II+\0", "MM\0+"].includes(String.fromCharCode(...magic));
    if (!isTiff) throw new Error(`found a file that is no TIFF (${file.name}), expected a GeoTIFF: ${CHOOSE}`);
    const original = new Original();
    await readable("the GeoTIFF's header is damaged", async () => {
      const tiff = await fromBlob(file);
      original.#image = await tiff.getImage();
      for (let i = 1, n = await tiff.getImageCount(); i < n; i++) {
        const image = await tiff.getImage(i);
        const isMask = ((image.fileDirectory.getValue("NewSubfileType") ?? 0) & IS_MASK) !== 0;
        if (isMask && image.getWidth() === original.nCols && image.getHeight() === original.nRows) original.#mask = image;
      }
    });
    const { nBands } = original;
    if (!(Number.isInteger(band) && band >= 1 && band <= nBands)) {
      throw new Error(`found band ${band}, expected 1${nBands > 1 ? ` to ${nBands}` : ", the only one"}`);
    }
    await original.#cutStrip();
    original.#refuseUnreadable(band - 1, magic[0] === "M".charCodeAt(0));
    await original.#describe(band - 1);
    return original;
  }

  get nBands() { return this.#image.getSamplesPerPixel(); }

  get nRows() { return this.#image.getHeight(); }

  get nCols() { return this.#image.getWidth(); }

  get isTiled() { return this.#image.isTiled; }

  /** Rows that are decoded together. */
  get tileRows() { return this.#image.getTileHeight(); }

  /** Make strips of some rows of an uncompressed one that has all rows: geotiff.js reads strips as a whole. */
  async #cutStrip() {
    const { fileDirectory: tags } = this.#image;
    const nRows = Math.max(Math.min(ROWS_AT_ONCE, Math.floor(MOST_DECODED / this.#bytesOfRow(0))), 1);
    const isOne = !this.isTiled && this.tileRows > nRows && this.tileRows >= this.nRows;
    if (!isOne || (tags.getValue("Compression") ?? 1) !== 1) return;
    const starts = Array.from({ length: Math.ceil(this.nRows / nRows) }, (_, i) => i * nRows);
    const offsets = await tags.loadValue("StripOffsets"); // one of each plane
    const sizes = await tags.loadValue("StripByteCounts"); // 0: a plane that was not written
    const strips = [...offsets].flatMap((offset, plane) => starts.map((row) => (sizes[plane] === 0 ? [0, 0]
      : [offset + row * this.#bytesOfRow(plane), Math.min(nRows, this.nRows - row) * this.#bytesOfRow(plane)])));
    tags.actualizedFields.set(TAGS.RowsPerStrip, nRows);
    tags.actualizedFields.set(TAGS.StripOffsets, strips.map(([offset]) => offset));
    tags.actualizedFields.set(TAGS.StripByteCounts, strips.map(([, size]) => size));
  }

  /** Return the bytes of a row of a strip or tile: of one band, where bands lie in planes of their own. */
  #bytesOfRow(band) {
    const hasPlanes = this.#image.planarConfiguration === 2;
    return this.#image.getTileWidth() * (hasPlanes ? this.#image.getSampleByteSize(band) : this.#image.getBytesPerPixel());
  }

  /** Refuse GeoTIFFs that geotiff.js reads wrong, or not at all. */
  #refuseUnreadable(band, isBigEndian) {
    const tag = (name) => this.#image.fileDirectory.getValue(name);
    const refuse = (found, expected, options) => {
      throw new Error(`found a GeoTIFF ${found}, expected ${expected}: convert it with gdal_translate ${options}, and choose the new file`);
    };
    const compression = tag("Compression") ?? 1;
    if (!(compression in COMPRESSIONS)) {
      const known = [...new Set(Object.values(COMPRESSIONS))].join(", ");
      refuse(`of compression ${compression}`, `one of ${known}`, "-co COMPRESS=DEFLATE");
    }
    if (this.tileRows * this.#bytesOfRow(band) > MOST_DECODED) {
      const found = `${this.isTiled ? "tiles" : "strips"} of ${this.tileRows} x ${this.#image.getTileWidth()} samples`;
      refuse(`of ${found}`, `at most ${MOST_DECODED / 2 ** 20} MiB in each`, "-co TILED=YES");
    }
    const [bits, predictor] = [this.#image.getBitsPerSample(band), tag("Predictor") ?? 1];
    if (!SIZES.includes(bits) || (bits === 16 && this.#image.getSampleFormat(band) === 3)) {
      const next = SIZES.find((size) => size > bits);
      refuse(`of ${bits} bits per sample`, `${next}, which hold the same numbers`, `-co NBITS=${next}`);
    }
    if (isBigEndian && predictor > 1 && bits > 8) {
      refuse(`of big-endian numbers with predictor ${predictor}`, "little-endian ones or no predictor", "-co ENDIANNESS=LITTLE");
    }
  }

  async #describe(band) {
    const image = this.#image;
    const told = (await image.getGDALMetadata(band)) ?? {};
    const extra = [].concat(...[image.fileDirectory.getValue("ExtraSamples") ?? []].map((value) => [...value]));
    const firstExtra = this.nBands - extra.length;
    this.bands = [band, ...extra.flatMap((kind, i) => (ALPHAS.includes(kind) && firstExtra + i !== band ? [firstExtra + i] : []))];
    this.dtype = `${KINDS[image.getSampleFormat(band)]}${image.getBitsPerSample(band)}`;
    // geotiff.js takes infinities for NaN.
    const [, sign] = /^\s*([+-]?)inf/i.exec(image.fileDirectory.getValue("GDAL_NODATA") ?? "") ?? [];
    this.nodata = sign === undefined ? image.getGDALNoData() : Number(`${sign}Infinity`);
    this.units = NO_UNIT.test((told.UNITTYPE ?? "").trim()) ? null : told.UNITTYPE.trim();
    this.scale = Number(told.SCALE ?? 1);
    this.offset = Number(told.OFFSET ?? 0);
    this.transform = this.#transform();
  }

  #transform() {
    const { fileDirectory: tags } = this.#image;
    const [scale, tie, matrix] = ["ModelPixelScale", "ModelTiepoint", "ModelTransformation"].map((name) => tags.getValue(name));
    let found = [1, 0, 0, 0, 1, 0];
    if (matrix) found = [0, 1, 3, 4, 5, 7].map((i) => matrix[i]);
    else if (scale && tie) {
      found = [scale[0], 0, tie[3] - tie[0] * scale[0], 0, -Math.abs(scale[1]), tie[4] + tie[1] * Math.abs(scale[1])];
    }
    const [a, b, c, d, e, f] = found;
    const isPoint = this.#image.getGeoKeys()?.GTRasterTypeGeoKey === IS_POINT;
    return isPoint ? [a, b, c - (a + b) / 2, d, e, f - (d + e) / 2] : found;
  }

  /** Return what differs from a `Terrain`, a line each; `isFatal`: heights cannot be compared. */
  problems(terrain) {
    const shape = ({ nRows, nCols }) => `${nRows} rows x ${nCols} columns`;
    if (this.nRows !== terrain.nRows || this.nCols !== terrain.nCols) {
      return { isFatal: true, lines: [`found a GeoTIFF of ${shape(this)}, expected ${shape(terrain)} as in the .twz file: ${CHOOSE}`] };
    }
    if (this.dtype !== terrain.dtype) {
      return { isFatal: true, lines: [`found a GeoTIFF of ${this.dtype}, expected ${terrain.dtype} as in the .twz file: ${CHOOSE}`] };
    }
    const lines = [];
    const metres = [this.units, terrain.units].map((name) => METRES[name?.toLowerCase()]);
    if (this.units !== terrain.units && (metres[0] === undefined || metres[0] !== metres[1])
      && (this.units !== null || IS_FLAT.test(terrain.crs ?? "[]"))) {
      lines.push(`units is ${terrain.units ?? "none"}, the original's is ${this.units ?? "none"}`);
    }
    for (const name of ["scale", "offset"]) {
      if (this[name] !== terrain[name]) lines.push(`${name} is ${terrain[name]}, the original's is ${this[name]}`);
    }
    const isFloat = this.dtype.startsWith("float");
    const [own, other] = [terrain.nodata, this.nodata].map((value) => (isFloat && Number.isNaN(value) ? NaN : storedNodata(value, this.dtype)));
    // -0 is 0, and NaN is NaN.
    if (own !== other && !(own !== own && other !== other)) lines.push(`nodata is ${terrain.nodata}, the original's is ${this.nodata}`);
    const found = terrain.transform();
    if (found.some((value, i) => value !== this.transform[i])) {
      lines.push(`the transform is ${found.join(", ")}, the original's is ${this.transform.join(", ")}`);
    }
    return { isFatal: false, lines };
  }

  /** Return { heights, valid } of a window { row, col, nRows, nCols }. */
  async read({ row, col, nRows, nCols }) {
    const window = [col, row, col + nCols, row + nRows];
    const place = `rows ${row} to ${row + nRows - 1} of the GeoTIFF cannot be read`;
    const [heights, ...alphas] = await readable(place, () => this.#image.readRasters({ window, samples: this.bands }));
    const [mask] = this.#mask ? await readable(place, () => this.#mask.readRasters({ window })) : [];
    const nodata = storedNodata(this.nodata, this.dtype);
    const valid = new Uint8Array(heights.length);
    const others = mask ? [...alphas, mask] : alphas;
    for (let i = 0; i < heights.length; i++) {
      const height = heights[i];
      valid[i] = height === height && height !== nodata && others.every((other) => other[i] > 0) ? 1 : 0;
    }
    return { heights, valid };
  }
}

/** Return what `read` returns, or fail with a line that says what cannot be read. */
async function readable(what, read) {
  try {
    return await read();
  } catch ({ message }) {
    throw new Error(`${what}: ${message}`);
  }
}
