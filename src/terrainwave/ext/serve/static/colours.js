// Colours by height: what MapLibre is told, and the legend.

// The lowest height that a terrain-RGB tile of an encoding can hold, in metres.
const LOWEST = { mapbox: -10000, terrarium: -32768 };
// Tiles have voids this many metres below the terrain's lowest height.
const VOID_DEPTH = 1;
const N_TICKS = 4;
const PLAIN = "#cfc8b8"; // terrain without colours by height
// Of the legend's length: ticks nearer to an end than this would cover its label.
const NEAR_END = 0.3;

/** Return [[height, colour], …] of a terrain in colours by this name, or in its own. */
export function stopsOf({ ramp, ramps, lowest }, colours) {
  return ramps[colours ?? ramp] ?? [[lowest, PLAIN], [lowest + 1, PLAIN]];
}

/** Return a color-relief-color expression of [[height, colour], …]; what is below them is clear. */
export function reliefOf(stops, encoding) {
  const lowest = LOWEST[encoding];
  const below = [stops[0][0] - VOID_DEPTH / 2, "rgba(0, 0, 0, 0)"];
  const all = [below, ...stops];
  const first = Math.max(all.findLastIndex(([height]) => height <= lowest), 0);
  const held = all.slice(first).map(([height, colour]) => [Math.max(height, lowest), colour]);
  return ["interpolate", ["linear"], ["elevation"], ...held.flat()];
}

/** Return a CSS gradient of the same stops, from left to right. */
export function gradientOf(stops) {
  const [low, high] = [stops[0][0], stops.at(-1)[0]];
  const places = stops.map(([height, colour]) => `${colour} ${100 * (height - low) / (high - low)}%`);
  return `linear-gradient(to right, ${places.join(", ")})`;
}

/** Return the heights that a legend from `low` to `high` names, ascending. */
export function ticksOf(low, high) {
  const wanted = (high - low) / N_TICKS;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= wanted);
  const ticks = [];
  for (let height = Math.ceil(low / step) * step; height < high; height += step) {
    const share = (height - low) / (high - low);
    if (share > NEAR_END && share < 1 - NEAR_END) ticks.push(height);
  }
  return [low, ...ticks, high];
}

/** Return a height as a legend writes it: no more digits than tell the ends apart. */
export function written(height, range) {
  const digits = Math.min(Math.max(1 - Math.floor(Math.log10(range || 1)), 0), 3);
  return `${height.toFixed(digits).replace(/^-0(\.0*)?$/, "0").replace("-", "−")}`;
}

/** Return a bound in so many digits, none of which make it smaller by more than the noise of floats. */
export function roundedUp(number, digits) {
  const near = Number(number.toPrecision(digits));
  if (!(near < number * (1 - 1e-12))) return near;
  return Number((near + 10 ** (Math.floor(Math.log10(number)) + 1 - digits)).toPrecision(digits));
}

/** Return a number with the unit of a terrain's heights, or alone where nobody knows it. */
export function withUnit(number, { units }) {
  return units ? `${number} ${units}` : `${number}`;
}
