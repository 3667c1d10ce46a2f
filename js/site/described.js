/** Description of a file for the page, as `terrainwave publish` writes it, but without PROJ. */

const EARTH = 6378137; // metres
const DEGREE = Math.PI / 180;
/** Metres from the middle of a plane to its furthest side, at most: a map ends near its poles. */
const MOST_OF_PLANE = 8e6;
export const METRES = { m: 1, metre: 1, meter: 1, metres: 1, meters: 1, km: 1000, ft: 0.3048, foot: 0.3048, feet: 0.3048 };
/** Heights that terrarium tiles hold: their steps are the finer ones. */
const TERRARIUM = [-32768, 32767];
const ORIGIN = /licen[cs]e|^lic$|copyright|rights|attribution|credit|source|author|provider|publisher|sensor/i;

/** Return the first number of a WKT's keyword, or null. */
function numberIn(wkt, keywords) {
  const found = new RegExp(`(?:${keywords})\\["[^"]*",\\s*([\\d.eE+-]+)`).exec(wkt);
  return found ? Number(found[1]) : null;
}

/** Return whether places are longitudes and latitudes: the CRS says so, and the bounds fit. */
export function isInDegrees({ crs, bounds: { left, right, bottom, top } }) {
  const fits = left >= -360 && right <= 720 && right - left <= 360.001 && bottom >= -90.001 && top <= 90.001;
  const isGeographic = crs === null || /^\w+:\w+$/.test(crs) ? !/^EPSG:(2|3|[5-9]\d{4}$)/.test(crs ?? "")
    : /^(GEOGCRS|GEODCRS|GEOGCS|GEOGRAPHICCRS|BOUNDCRS\[SOURCECRS\[GEOGCRS|COMPD_?CS\["[^"]*",\s*GEOGCS|COMPOUNDCRS\["[^"]*",\s*GEOGCRS)/.test(crs);
  return fits && isGeographic;
}

/**
 * Return a terrain for the page's list; `ramps` are those of another one. Longitudes and latitudes lie where they are; all other
 * rasters lie on a plane at 0° N 0° E: `plane` has the coordinates of that place, and degrees in one unit of them.
 */
export function describe(terrain, name, ramps) {
  // A raster that lies nowhere has rows from the north.
  const [a, b, c, d, e, f] = terrain.metadata.transform ? terrain.transform() : [1, 0, 0, 0, -1, terrain.nRows];
  const isPlane = !isInDegrees(terrain);
  const wkt = terrain.crs ?? "";
  const axis = numberIn(wkt, "ELLIPSOID|SPHEROID") ?? EARTH;
  const unit = (isPlane && numberIn(wkt.slice(wkt.toUpperCase().lastIndexOf("CARTESIAN")), "LENGTHUNIT")) || 1;
  const { left, bottom, right, top } = terrain.bounds;
  const half = (Math.max(right - left, top - bottom) * unit) / 2;
  // Degrees of the map in one unit of x and y; and what lies at 0, 0.
  const degrees = isPlane ? (unit * Math.min(1, MOST_OF_PLANE / half)) / (axis * DEGREE) : 1;
  const [x0, y0] = isPlane ? [(left + right) / 2, (bottom + top) / 2] : [0, 0];
  const mapped = [(left - x0) * degrees, (bottom - y0) * degrees, (right - x0) * degrees, (top - y0) * degrees];
  const [west, south, east, north] = isPlane ? mapped : [left, Math.max(bottom, -90), right, Math.min(top, 90)];

  // Rows and columns are linear: a constant, and what they grow by from the middle to the sides.
  const determinant = a * e - b * d;
  const [x, y] = [(left + right) / 2 - c, (bottom + (top - bottom) / 2) - f];
  const [wide, high] = [(east - west) / degrees / 2, (north - south) / degrees / 2];
  const line = (ofX, ofY) => {
    const middle = ofX * x + ofY * y - 0.5;
    return ofX === 0 ? [[middle], [ofY * high]] : ofY === 0 ? [[middle, ofX * wide]] : [[middle, ofX * wide], [ofY * high, 0]];
  };
  const isRound = !isPlane && b === 0 && d === 0 && Math.abs(right - left - 360) < 1e-6;

  const metres = (METRES[terrain.units] ?? 1) * (terrain.heightsAre === "depth" ? -1 : 1);
  const base = terrain.heightsAre === "radius" ? axis : 0;
  const reached = [terrain.rawMin, terrain.rawMax].map((raw) => (raw * terrain.scale + terrain.offset) * metres - base);
  const error = terrain.effectiveBound * Math.abs(metres);
  const [lowest, highest] = [Math.min(...reached) - error, Math.max(...reached) + error];
  const pixel = Math.abs(e) * degrees * DEGREE * axis;
  const { tags = {}, band_tags: ofBand = {} } = terrain.metadata;
  return {
    name, lowest, highest, error, bounds: [west, south, east, north],
    maxzoom: Math.min(Math.max(Math.ceil(Math.log2((2 * Math.PI * axis) / (256 * pixel))), 0), 24),
    encoding: lowest > TERRARIUM[0] && highest < TERRARIUM[1] ? "terrarium" : "mapbox",
    units: terrain.units === null ? null : terrain.units in METRES ? "m" : terrain.units,
    bytes: terrain.fileSize, rows: terrain.nRows, columns: terrain.nCols,
    bits_per_sample: (8 * terrain.fileSize) / (terrain.nRows * terrain.nCols),
    method: terrain.method, on_earth: axis === EARTH, ramp: "cividis", ramps: stretched(ramps, lowest, highest),
    origin: Object.fromEntries(Object.entries({ ...tags, ...ofBand }).filter(([tag]) => ORIGIN.test(tag)).slice(0, 8)),
    placed: {
      domain: [west, south, east, north], rows: line(-d / determinant, a / determinant), cols: line(e / determinant, -b / determinant),
      turn: !isPlane && b === 0 && d === 0 ? 360 / a : null, goes_round: isRound,
      metres, radii: terrain.heightsAre === "radius", pixel, axis, polar_axis: axis,
    },
    ...(isPlane && { plane: { x: x0, y: y0, degrees } }),
  };
}

/** Return ramps of another terrain, { name: [[height, colour], …] }, from `lowest` to `highest`. */
function stretched(ramps, lowest, highest) {
  const span = highest - lowest || 1;
  return Object.fromEntries(Object.entries(ramps).map(([name, stops]) => {
    const [low, high] = [stops[0][0], stops.at(-1)[0]];
    return [name, stops.map(([height, colour]) => [lowest + (span * (height - low)) / (high - low), colour])];
  }));
}

/** Return what the file says of itself, as `terrainwave info` names it: [name, text]. `isVoid`: nothing is valid. */
export function factsOf(terrain, root, isVoid) {
  const { metadata, nRows, nCols, nLevels, dtype, method, units, fileSize: bytes } = terrain;
  const inUnits = (value) => `${value}${units ? ` ${units}` : ""}`;
  const levels = Array.from({ length: nLevels }, (_, k) => terrain.shape(k)).map((level) => `${level.nRows} × ${level.nCols}`);
  const { left, bottom, right, top } = terrain.bounds;
  const side = { above: ", none below the original", below: ", none above the original" }[metadata.bound] ?? "";
  return [
    ["File", `${bytes.toLocaleString("en")} bytes`],
    ["Size", `${nRows} rows × ${nCols} columns, ${dtype}`],
    ["Bits per sample", ((8 * bytes) / (nRows * nCols)).toPrecision(4)],
    ["Largest error", `asked ${inUnits(terrain.maxError)}, holds ${inUnits(terrain.effectiveBound)}${side}`],
    ["Heights", isVoid ? "none: all samples are void" : `${inUnits(terrain.rawMin * terrain.scale + terrain.offset)} to ${inUnits(terrain.rawMax * terrain.scale + terrain.offset)}`],
    ["Unit", units ?? "unknown"],
    ["Voids", terrain.hasVoids ? "some" : "none"],
    ["Nodata", terrain.nodata === null ? "none" : `${terrain.nodata}`],
    ["Method", method],
    ["Block", `${terrain.blockSize} × ${terrain.blockSize} cells`],
    ["Levels", `${nLevels}: ${levels.join(", ")}`],
    ["CRS", terrain.crs ?? "none"],
    ["Bounds", [left, bottom, right, top].join(", ")],
    ["Pixel", `${terrain.transform()[0]}, ${terrain.transform()[4]}`],
    ["Root of heights", root ?? "not stated"],
    ...["description", "software"].filter((name) => metadata[name]).map((name) => [name, metadata[name]]),
    ...Object.entries({ ...metadata.tags, ...metadata.band_tags }),
  ];
}
