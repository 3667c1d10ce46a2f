/** Comparison of decoded heights with an original by the rule of `terrainwave verify`: numbers only, no page. */

const FLOATS = { float32: [Float32Array, Uint32Array, 1], float64: [Float64Array, BigUint64Array, 1n] };
/** Bars of the histogram on each side of 0, at most. */
const MOST_BARS = 16;

/** Return [numerator, denominator] of the decimal number that a float is written as. */
function fractionOf(value) {
  const [, whole, digits = "", power = "0"] = /^(\d+)(?:\.(\d+))?(?:e([+-]\d+))?$/.exec(String(Math.abs(value)));
  const [number, shift] = [BigInt(whole + digits), BigInt(power) - BigInt(digits.length)];
  return shift < 0n ? [number, 10n ** -shift] : [number * 10n ** shift, 1n];
}

/** Return the whole steps of `scale` in `bound`: 8 steps of 0.1 may read 7.999999999999999, hence the slack. */
function wholeSteps(bound, scale) {
  const [[a, b], [c, d]] = [fractionOf(bound), fractionOf(scale)];
  const slack = 10n ** 9n;
  return Number((a * d * slack + b * c) / (b * c * slack));
}

/** Return the distance of a float from the next larger one of a dtype; 0 where none is finite. */
function ulpOf(dtype, value) {
  const [Float, Bits, one] = FLOATS[dtype];
  const float = Float.of(value);
  const bits = new Bits(float.buffer);
  const before = float[0];
  bits[0] += one;
  const ulp = float[0] - before;
  return Number.isFinite(ulp) ? ulp : 0;
}

/** Return what equals a nodata value in heights of a dtype; null: nothing does. */
export function storedNodata(nodata, dtype) {
  if (nodata === null || Number.isNaN(nodata)) return null;
  if (dtype === "float32") return Math.fround(nodata);
  if (dtype === "float64") return nodata;
  const [, isUnsigned, bits] = /^(u?)int(\d+)$/.exec(dtype);
  const [low, high] = isUnsigned ? [0, 2 ** bits - 1] : [-(2 ** (bits - 1)), 2 ** (bits - 1) - 1];
  return Number.isInteger(nodata) && nodata >= low && nodata <= high ? nodata : null;
}

/**
 * Return the side of stored numbers: 1 above their originals, -1 below, 0 both, null where it cannot be decided: nobody
 * named heights or depths, and a code of the CRS may stand for a downward axis (there is no PROJ). Codes of EPSG below
 * 5000 and of five digits from 21000 on are old ones, none of which counts depths.
 */
function sideOf({ boundSide, scale, heightsAre, crs }) {
  const side = boundSide * Math.sign(scale);
  if (side === 0 || heightsAre !== null) return heightsAre === "depth" ? -side : side;
  if (/\bAXIS\s*\[\s*"[^"]*"\s*,\s*down\b/i.test(crs ?? "")) return -side;
  return crs === null || crs.includes("[") || /^(IAU_\d+:.*|EPSG:([1-4]\d{3}|2[1-9]\d{3}|3[0-2]\d{3}))$/.test(crs) ? side : null;
}

/**
 * Sums over the samples of a file. `file` has dtype, method, maxError, effectiveBound, rawRho, scale, boundSide,
 * heightsAre and crs of a `Terrain`; `nodata` is the original's.
 */
export class Comparison {
  constructor(file, nodata) {
    const { dtype, effectiveBound: bound, scale } = file;
    const isFloat = dtype in FLOATS;
    this.dtype = dtype;
    this.scale = Math.abs(scale);
    this.sign = Math.sign(scale);
    this.allowed = isFloat ? bound / this.scale : wholeSteps(bound, scale);
    // Division by the scale may have rounded down.
    if (isFloat && this.scale !== 1) this.allowed += ulpOf("float64", this.allowed);
    // Floats on a decimal grid are up to half an ulp off it, both of them.
    this.hasUlp = isFloat && bound > 0 && file.rawRho === 0;
    this.keepsSigns = isFloat && bound === 0 && file.maxError === 0 && file.method !== "cdf53";
    this.side = sideOf(file);
    this.nodata = storedNodata(nodata, dtype);
    // Bars are of one width, an odd number of whole steps for integers; the middle one lies around 0.
    this.width = isFloat ? (2 * this.allowed) / (2 * MOST_BARS + 1) : 1 + 2 * Math.ceil(Math.max(this.allowed - MOST_BARS, 0) / (2 * MOST_BARS + 1));
    this.nBars = isFloat ? (bound > 0 ? MOST_BARS : 0) : Math.ceil((this.allowed - (this.width - 1) / 2) / this.width);
    /** Distance of a bar's values from its middle, at most. */
    this.half = isFloat ? this.width / 2 : (this.width - 1) / 2;
    this.found = {
      nSamples: 0, nValid: 0, largest: 0, squares: 0, worst: null, nBeyond: 0, beyond: null, excess: 0,
      nVoid: 0, oneVoid: null, nSide: 0, wrongSide: null, nSigns: 0, sign: null, nTaken: 0,
      bars: new Array(2 * this.nBars + 1).fill(0),
    };
  }

  /** Add a window from (row, col) on: the original's heights and validity, and those of the file. */
  add({ row, col, nCols }, original, valid, heights, decodedValid) {
    const { found, allowed, side, nodata, nBars, width, sign } = this;
    for (let i = 0; i < original.length; i++) {
      if (decodedValid[i] && heights[i] === nodata) found.nTaken++;
      if (!valid[i] !== !decodedValid[i]) {
        found.nVoid++;
        found.oneVoid ??= placeOf(i);
      }
      if (!valid[i] || !decodedValid[i]) continue;
      const [one, other] = [original[i], heights[i]];
      const signed = other - one;
      // NaN or infinity on one side, which no bound covers.
      const difference = signed === signed ? Math.abs(signed) : Infinity;
      found.nValid++;
      found.squares += difference * difference;
      if (difference > found.largest) {
        found.largest = difference;
        found.worst = { ...placeOf(i), original: one, decoded: other };
      }
      const isBeyond = difference > allowed && this.#beyond(difference, one, other, () => placeOf(i));
      if (side && (side > 0 ? other < one : other > one)) {
        found.nSide++;
        found.wrongSide ??= placeOf(i);
      }
      if (one === 0 && other === 0 && this.keepsSigns && !Object.is(one, other)) {
        found.nSigns++;
        found.sign ??= placeOf(i);
      }
      if (!isBeyond) found.bars[nBars + Math.min(Math.max(Math.round((sign * signed) / width) || 0, -nBars), nBars)]++;
    }
    found.nSamples += original.length;

    function placeOf(i) {
      return { row: row + Math.floor(i / nCols), col: col + (i % nCols) };
    }
  }

  #beyond(difference, one, other, placeOf) {
    const { found, dtype } = this;
    const ulp = this.hasUlp ? ulpOf(dtype, Math.max(Math.abs(one), Math.abs(other))) : 0;
    const excess = difference - this.allowed - ulp;
    if (!(excess > 0)) return false;
    found.nBeyond++;
    if (excess > found.excess) {
      found.excess = excess;
      found.beyond = { ...placeOf(), difference };
    }
    return true;
  }

  /** Add what another comparison of the same file found, in a worker. */
  merge(other) {
    const { found } = this;
    for (const name of ["nSamples", "nValid", "squares", "nBeyond", "nVoid", "nSide", "nSigns", "nTaken"]) {
      found[name] += other[name];
    }
    for (const name of ["oneVoid", "wrongSide", "sign"]) found[name] = firstOf(found[name], other[name]);
    if (other.largest > found.largest
      || (other.largest === found.largest && firstOf(found.worst, other.worst) === other.worst)) {
      [found.largest, found.worst] = [other.largest, other.worst];
    }
    if (other.excess > found.excess) [found.excess, found.beyond] = [other.excess, other.beyond];
    other.bars.forEach((n, i) => { found.bars[i] += n; });
  }

  /**
   * Return { maxError, rmse } in physical units, the histogram's bars [{ from, to, n }], problems, a line each, and
   * whether the side of a one-sided bound was not checked.
   */
  report() {
    const { found, scale, nBars, allowed, width, half } = this;
    const at = ({ row, col }) => `at row ${row}, column ${col}`;
    const samples = (n) => (n === 1 ? "1 sample is" : `${n} samples are`);
    const problems = [];
    if (found.nVoid) {
      problems.push(`${samples(found.nVoid)} void in one of the two and valid in the other, the first ${at(found.oneVoid)}`);
    }
    if (found.nTaken) problems.push(`${found.nTaken} valid samples decode to the nodata value ${this.nodata}`);
    if (found.nBeyond) {
      problems.push(`${samples(found.nBeyond)} further from the original than ${allowed * scale}; the worst,`
        + ` ${at(found.beyond)}, by ${found.beyond.difference * scale}`);
    }
    if (found.nSigns) problems.push(`${samples(found.nSigns)} 0.0 in one of the two and -0.0 in the other, the first ${at(found.sign)}`);
    if (found.nSide) problems.push(`${samples(found.nSide)} on the wrong side of the original, the first ${at(found.wrongSide)}`);
    return {
      nValid: found.nValid, maxError: found.largest * scale, worst: found.worst, problems,
      rmse: Math.sqrt(found.squares / Math.max(found.nValid, 1)) * scale,
      isSideUnknown: this.side === null,
      bars: found.bars.map((n, i) => ({ from: ((i - nBars) * width - half) * scale, to: ((i - nBars) * width + half) * scale, n })),
    };
  }
}

/** Return the place that comes first row by row; null comes last. */
function firstOf(one, other) {
  if (!one || !other) return one ?? other;
  return other.row < one.row || (other.row === one.row && other.col < one.col) ? other : one;
}
