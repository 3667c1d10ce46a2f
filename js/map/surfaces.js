/** Square grids of heights, row by row, NaN where there is none. */

/** Return a grid of n x n without the `margin` outermost lines of each side. */
export function without(values, n, margin) {
  if (margin === 0) return values;
  const side = n - 2 * margin;
  const found = new values.constructor(side * side);
  for (let i = 0; i < side; i++) {
    const from = (i + margin) * n + margin;
    found.set(values.subarray(from, from + side), i * side);
  }
  return found;
}

/** Return every second value of every second row of a grid of n x n, n odd. */
export function everySecond(values, n) {
  const side = (n + 1) / 2;
  const found = new Float64Array(side * side);
  for (let i = 0; i < side; i++) {
    for (let j = 0; j < side; j++) found[i * side + j] = values[2 * i * n + 2 * j];
  }
  return found;
}

/** Return heights that reach `times` samples into NaN: there, the mean of known neighbours. */
export function growInto(heights, n, times) {
  const to = heights.slice();
  // Heights of one round are used by the next one only, which fills the places beside them.
  let wanted = [];
  for (let at = 0; at < to.length && times > 0; at++) if (Number.isNaN(to[at])) wanted.push(at);
  for (let time = 0; time < times && wanted.length > 0; time++) {
    const [filled, values] = [[], []];
    for (const at of wanted) {
      if (!Number.isNaN(to[at])) continue; // named by two neighbours
      const mean = meanAround(to, n, at);
      if (Number.isNaN(mean)) continue;
      filled.push(at);
      values.push(mean);
    }
    wanted = [];
    filled.forEach((at, i) => { to[at] = values[i]; });
    for (const at of filled) for (const beside of around(n, at)) if (Number.isNaN(to[beside])) wanted.push(beside);
  }
  return to;
}

/** Return the places beside one. */
function around(n, at) {
  const [row, col, found] = [Math.floor(at / n), at % n, []];
  for (let i = Math.max(row - 1, 0); i <= Math.min(row + 1, n - 1); i++) {
    for (let j = Math.max(col - 1, 0); j <= Math.min(col + 1, n - 1); j++) found.push(i * n + j);
  }
  return found;
}

function meanAround(heights, n, at) {
  const [row, col] = [Math.floor(at / n), at % n];
  const [lastRow, lastCol] = [Math.min(row + 1, n - 1), Math.min(col + 1, n - 1)];
  let [sum, count] = [0, 0];
  for (let i = Math.max(row - 1, 0); i <= lastRow; i++) {
    for (let j = Math.max(col - 1, 0); j <= lastCol; j++) {
      const height = heights[i * n + j];
      if (Number.isNaN(height)) continue;
      sum += height;
      count++;
    }
  }
  return count ? sum / count : NaN;
}

/**
 * Return how much of each pixel is void, 0 … 255: of a grid of n x n that is twice as fine and has
 * `rim` pixels around, weighted 1 2 1 across them.
 */
export function shareOfVoids(heights, n, rim) {
  const side = (n + 1) / 2 - 2 * rim;
  const shares = new Uint8Array(side * side);
  const held = (place) => Math.min(Math.max(place, 0), n - 1);
  for (let i = 0; i < side; i++) {
    for (let j = 0; j < side; j++) {
      let sum = 0;
      for (let di = -1; di <= 1; di++) {
        const row = held(2 * (i + rim) + di) * n;
        for (let dj = -1; dj <= 1; dj++) {
          const isVoid = Number.isNaN(heights[row + held(2 * (j + rim) + dj)]);
          if (isVoid) sum += (2 - Math.abs(di)) * (2 - Math.abs(dj));
        }
      }
      shares[i * side + j] = Math.round((255 * sum) / 16);
    }
  }
  return shares;
}

/**
 * Return the largest distance of a coarse grid's bilinear surface from `surface` of side x side,
 * twice as fine; 0 where there is nothing to compare.
 */
export function largestDistance(coarse, surface, side) {
  const n = (side + 1) / 2;
  let largest = 0;
  for (let i = 0; i < side; i++) {
    const [top, bottom] = [(i >> 1) * n, ((i + 1) >> 1) * n];
    for (let j = 0; j < side; j++) {
      const [left, right] = [j >> 1, (j + 1) >> 1];
      const drawn = (coarse[top + left] + coarse[top + right] + coarse[bottom + left] +
        coarse[bottom + right]) / 4;
      const distance = Math.abs(drawn - surface[i * side + j]);
      if (distance > largest) largest = distance;
    }
  }
  return largest;
}
