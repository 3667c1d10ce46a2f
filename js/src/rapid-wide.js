/** What rapid-rows.js does, for heights whose sums need more than 32 bits: at most 2^51 (R.2). */

import { DOWN, HH, HL, LH, MOST_ERROR } from "./rapid-rows.js";

const A = 3;
const around = (plane, rows, cols) => rows.flatMap((r) => cols.map((c) => [plane, r, c]));
const of = (plane, ...places) => places.map(([r, c]) => [plane, r, c]);
const own = (plane) => around(plane, [-1], [-1, 0, 1]);

/** Taps [plane, row, column] by plane, in the order of the weights (R.6). */
const TAPS = [
  [...around(A, [-1, 0, 1, 2], [-1, 0, 1, 2]), ...own(HH)],
  [
    ...around(A, [0], [-1, 0, 1, 2]), ...around(A, [-1], [0, 1]), ...around(A, [1], [0, 1]),
    ...around(HH, [-1, 0], [-1, 0, 1]), ...of(HH, [-2, 0], [1, 0]), ...own(HL),
  ],
  [
    ...around(A, [-1, 0, 1, 2], [0]), ...around(A, [0], [-1, 1]), ...around(A, [1], [-1, 1]),
    ...own(LH), ...around(HH, [0], [-2, -1, 0, 1]),
    ...around(HH, [-1], [-1, 0]), ...around(HH, [1], [-1, 0]), ...around(HL, [0, 1], [-1, 0]),
  ],
];
const CORES = [
  around(A, [0, 1], [0, 1]),
  [...of(A, [0, 0], [0, 1]), ...of(HH, [-1, 0], [0, 0])],
  [...of(A, [0, 0], [1, 0]), ...of(HH, [0, -1], [0, 0])],
];
const BENT = [around(A, [0, 1], [0, 1]), around(A, [0], [0, 1]), around(A, [0, 1], [0])];
const NEAR = [
  [], of(HH, [-1, 0], [0, 0]), [...around(HH, [0], [-1, 0]), ...around(HL, [0, 1], [-1, 0])],
];
const FAR = [[], around(HH, [-1, 0], [-1, 1]), around(HH, [-1, 1], [-1, 0])];

function predict(plane) {
  return (m, first, n, weights, features) => {
    const heights = [...m.planes, m.coarse];
    const at = (arrays, [p, r, c], i) => arrays[p][i + r * m.stride + c];
    const total = (arrays, taps, i) => taps.reduce((sum, tap) => sum + at(arrays, tap, i), 0);
    const curved = [null, null, null, m.bends];
    for (let j = 0; j < n; j++) {
      const i = first + j;
      const sum = TAPS[plane].reduce((p, tap, k) => p + weights[k] * at(heights, tap, i), 32);
      m.predicted[j] = Math.floor(sum / 64);
      const core = CORES[plane].map((tap) => at(heights, tap, i));
      const [a, b, c, d] = core;
      m.least[j] = Math.min(...core);
      m.most[j] = Math.max(...core);
      m.sum[j] = a + b + c + d;
      m.twist[j] = Math.abs(plane === HH ? a - b - c + d : a + b - c - d);
      const error = (r, c) => at(m.errors, [plane, r, c], i);
      m.expected[j] = features[1] * error(-1, 0) + features[2] * (error(-1, -1) + error(-1, 1)) +
        features[3] * error(-2, 0) + features[6] * total(curved, BENT[plane], i) +
        features[7] * total(m.errors, NEAR[plane], i) + features[8] * total(m.errors, FAR[plane], i);
    }
  };
}

export const predictRow = [predict(HH), predict(HL), predict(LH)];

export function fillContexts(m, n, features, scale) {
  const { rangeShift, mostRange, isFine, isByReach, sideShift, sideScale, farScale, endShift } = scale;
  const inRange = (x) => Math.min(Math.floor(x / 2 ** rangeShift), mostRange);
  for (let j = 0; j < n; j++) {
    const [low, high] = [m.least[j], m.most[j]];
    const p = Math.min(Math.max(m.predicted[j], 64 * low), 64 * high);
    const w = Math.floor((p + 32) / 64);
    m.predicted[j] = p;
    m.whole[j] = w;
    const total = m.expected[j] + features[0] + features[4] * inRange(high - low) +
      features[5] * inRange(m.twist[j]);
    const e = Math.floor(total / 16);
    const log2 = 31 - Math.clz32(e);
    const bin = e < 32 ? 0 : Math.min(2 * log2 + ((e >> (log2 - 1)) & 1) - 10, 43);
    let side = 16 * m.sum[j] - p;
    let sigma = 0;
    if (isFine && (bin < 16 || !isByReach)) {
      side = p - 64 * w;
      sigma = bin < 16 ? Math.min((Math.abs(side) * sideScale) >> 16, 3) : 0;
    } else {
      const reach = side < 0 ? 64 * high - p : p - 64 * low;
      const distance = isByReach ? reach : Math.abs(side);
      const far = Math.min(Math.floor(distance / 2 ** sideShift), 2 ** 20 - 1);
      const x = (far * farScale) >> endShift;
      const marks = isByReach ? [8, 24, 48] : [4, 11, 24];
      sigma = marks.filter((mark) => 4 * x > mark * e).length;
    }
    m.contexts[j] = (4 * bin + sigma) | (side < 0 ? DOWN : 0);
  }
}

export function noteErrors(m, plane, at, first, stop, { errorShift }) {
  for (let j = first; j < stop; j++) {
    const error = Math.abs(64 * m.planes[plane][at + j] - m.predicted[j]);
    m.errors[plane][at + j] = Math.min(Math.floor(error / 2 ** errorShift), MOST_ERROR);
  }
}
