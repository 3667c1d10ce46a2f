/*
 * Rows of method rapid (docs/format-rapid.md), as js/src/rapid-rows.js and rapid-streams.js have
 * them. Sums wrap at 32 bits, as there (-fwrapv). Pointers are to a row's first sample.
 */

typedef int i32;

#define EXPORT(name) __attribute__((export_name(name)))
#define ROWS _Pragma("clang loop vectorize(assume_safety)")

static inline i32 min(i32 a, i32 b) { return a < b ? a : b; }
static inline i32 max(i32 a, i32 b) { return a > b ? a : b; }
static inline i32 magnitude(i32 a) { return a < 0 ? -a : a; }

/* What a row is computed in: arrays of m numbers, one after the other, in this order. */
#define TAKE_ROW(row, m)                                                                    \
  i32 *predicted = row, *least = row + m, *most = row + 2 * m, *sum = row + 3 * m,          \
      *twist = row + 4 * m, *expected = row + 5 * m

/* Locals, which stores to rows cannot change. */
#define COPY(to, from, n)                                                                   \
  i32 to[n];                                                                                \
  _Pragma("clang loop unroll(full)") for (i32 k = 0; k < n; k++) to[k] = from[k]

EXPORT("fillBends")
void fill_bends(i32 n, i32 s, const i32 *a, i32 *bends, i32 shift, i32 most) {
  ROWS for (i32 j = 0; j < n; j++) {
    const i32 *at = a + j;
    i32 across = at[-2] + at[2] - 4 * (at[-1] + at[1]) + 6 * at[0];
    i32 along = at[-2 * s] + at[2 * s] - 4 * (at[-s] + at[s]) + 6 * at[0];
    i32 both = magnitude(across) + magnitude(along);
    bends[j] = min(both >> shift, most);
  }
}

EXPORT("predictHH")
void predict_hh(i32 n, i32 s, const i32 *a, const i32 *own, const i32 *error, const i32 *bends,
                const i32 *weights, const i32 *features, i32 *row, i32 m) {
  TAKE_ROW(row, m);
  COPY(w, weights, 19);
  COPY(f, features, 9);
  ROWS for (i32 j = 0; j < n; j++) {
    const i32 *up = a + j - s, *at = a + j, *down = a + j + s, *low = a + j + 2 * s;
    i32 p = 32 + w[0] * up[-1] + w[1] * up[0] + w[2] * up[1] + w[3] * up[2];
    p += w[4] * at[-1] + w[5] * at[0] + w[6] * at[1] + w[7] * at[2];
    p += w[8] * down[-1] + w[9] * down[0] + w[10] * down[1] + w[11] * down[2];
    p += w[12] * low[-1] + w[13] * low[0] + w[14] * low[1] + w[15] * low[2];
    p += w[16] * own[j - s - 1] + w[17] * own[j - s] + w[18] * own[j - s + 1];
    predicted[j] = p >> 6;
    i32 b = at[1], c = down[0], d = down[1];
    least[j] = min(min(at[0], b), min(c, d));
    most[j] = max(max(at[0], b), max(c, d));
    sum[j] = at[0] + b + c + d;
    twist[j] = magnitude(at[0] + d - b - c);
    const i32 *north = error + j - s;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] +
                  f[6] * (bends[j] + bends[j + 1] + bends[j + s] + bends[j + s + 1]);
  }
}

EXPORT("predictHL")
void predict_hl(i32 n, i32 s, const i32 *a, const i32 *hh, const i32 *own, const i32 *error_hh,
                const i32 *error, const i32 *bends, const i32 *weights, const i32 *features, i32 *row, i32 m) {
  TAKE_ROW(row, m);
  COPY(w, weights, 19);
  COPY(f, features, 9);
  ROWS for (i32 j = 0; j < n; j++) {
    const i32 *at = a + j, *h = hh + j, *up = hh + j - s;
    i32 p = 32 + w[0] * at[-1] + w[1] * at[0] + w[2] * at[1] + w[3] * at[2];
    p += w[4] * at[-s] + w[5] * at[1 - s] + w[6] * at[s] + w[7] * at[s + 1];
    p += w[8] * up[-1] + w[9] * up[0] + w[10] * up[1] + w[11] * h[-1] + w[12] * h[0];
    p += w[13] * h[1] + w[14] * up[-s] + w[15] * h[s];
    p += w[16] * own[j - s - 1] + w[17] * own[j - s] + w[18] * own[j - s + 1];
    predicted[j] = p >> 6;
    i32 across = at[0] + at[1], along = up[0] + h[0];
    least[j] = min(min(at[0], at[1]), min(up[0], h[0]));
    most[j] = max(max(at[0], at[1]), max(up[0], h[0]));
    sum[j] = across + along;
    twist[j] = magnitude(across - along);
    const i32 *north = error + j - s, *e = error_hh + j, *e_up = error_hh + j - s;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] +
                  f[6] * (bends[j] + bends[j + 1]) + f[7] * (e_up[0] + e[0]) +
                  f[8] * (e_up[-1] + e[-1] + e_up[1] + e[1]);
  }
}

EXPORT("predictLH")
void predict_lh(i32 n, i32 s, const i32 *a, const i32 *hh, const i32 *hl, const i32 *own,
                const i32 *error_hh, const i32 *error_hl, const i32 *error, const i32 *bends,
                const i32 *weights, const i32 *features, i32 *row, i32 m) {
  TAKE_ROW(row, m);
  COPY(w, weights, 23);
  COPY(f, features, 9);
  ROWS for (i32 j = 0; j < n; j++) {
    const i32 *at = a + j, *down = a + j + s, *h = hh + j, *l = hl + j, *north_own = own + j - s;
    i32 p = 32 + w[0] * at[-s] + w[1] * at[0] + w[2] * down[0] + w[3] * down[s];
    p += w[4] * at[-1] + w[5] * at[1] + w[6] * down[-1] + w[7] * down[1];
    p += w[8] * north_own[-1] + w[9] * north_own[0] + w[10] * north_own[1] + w[11] * h[-2];
    p += w[12] * h[-1] + w[13] * h[0] + w[14] * h[1] + w[15] * h[-s - 1] + w[16] * h[-s];
    p += w[17] * h[s - 1] + w[18] * h[s] + w[19] * l[-1] + w[20] * l[0];
    p += w[21] * l[s - 1] + w[22] * l[s];
    predicted[j] = p >> 6;
    i32 across = at[0] + down[0], along = h[-1] + h[0];
    least[j] = min(min(at[0], down[0]), min(h[-1], h[0]));
    most[j] = max(max(at[0], down[0]), max(h[-1], h[0]));
    sum[j] = across + along;
    twist[j] = magnitude(across - along);
    const i32 *north = error + j - s, *e = error_hh + j, *g = error_hl + j;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] +
                  f[6] * (bends[j] + bends[j + s]) +
                  f[7] * (e[-1] + e[0] + g[-1] + g[0] + g[s - 1] + g[s]) +
                  f[8] * (e[-s - 1] + e[-s] + e[s - 1] + e[s]);
  }
}

/* The bin of e >= 32: 2 lg e + its second bit - 10, out of the exponent of a float (R.7). */
static inline i32 bin_of(i32 e) {
  union { float number; i32 bits; } float_of = {(float)(e & ~7)}; /* 24 bits: exact */
  return e < 32 ? 0 : min((float_of.bits >> 22) - 264, 43);
}

EXPORT("fillContexts")
void fill_contexts(i32 n, const i32 *f, i32 *row, i32 m, i32 range_shift, i32 most_range,
                   i32 is_fine, i32 side_shift, i32 side_scale, i32 end_shift) {
  TAKE_ROW(row, m);
  i32 *whole = row + 6 * m, *contexts = row + 7 * m;
  const i32 of_const = f[0], of_range = f[4], of_twist = f[5];
  ROWS for (i32 j = 0; j < n; j++) {
    i32 low = least[j], high = most[j];
    i32 p = min(max(predicted[j], low << 6), high << 6);
    i32 w = (p + 32) >> 6;
    predicted[j] = p;
    whole[j] = w;
    i32 e = expected[j] + of_const + of_range * min((high - low) >> range_shift, most_range) +
            of_twist * min(twist[j] >> range_shift, most_range);
    expected[j] = e >> 4;
  }
  if (is_fine) {
    ROWS for (i32 j = 0; j < n; j++) {
      i32 bin = bin_of(expected[j]);
      i32 side = predicted[j] - (whole[j] << 6);
      i32 near = min((magnitude(side) * side_scale) >> 16, 3);
      contexts[j] = (4 * bin + (bin < 16 ? near : 0)) | (side < 0 ? 256 : 0);
    }
    return;
  }
  ROWS for (i32 j = 0; j < n; j++) {
    i32 e = expected[j]; /* below 2^27: eleven times it fit */
    i32 side = (sum[j] << 4) - predicted[j];
    i32 x = (min(magnitude(side) >> side_shift, (1 << 20) - 1) * side_scale) >> end_shift;
    i32 far = (x > e ? 1 : 0) + (4 * x > 11 * e ? 1 : 0) + (x > 6 * e ? 1 : 0);
    contexts[j] = (4 * bin_of(e) + far) | (side < 0 ? 256 : 0);
  }
}

/*
 * Read the symbols first ... stop - 1 of a row into its details; return whether any has raw bits
 * (R.8). `used` counts symbols and words; words[n_words] stands for all beyond the end.
 */
EXPORT("readSymbols")
i32 read_symbols(i32 first, i32 stop, i32 *row, i32 m, const unsigned char *valid,
                 const unsigned char *slots, const i32 *frequencies, unsigned *states, i32 last,
                 const unsigned short *words, i32 n_words, i32 *used) {
  const i32 *contexts = row + 7 * m;
  i32 *details = row + 8 * m;
  i32 n_symbols = used[0], n_words_used = used[1], has_raw = 0;
  for (i32 j = first; j < stop; j++) {
    if (valid && !valid[j]) {
      details[j] = 0;
      continue;
    }
    i32 context = contexts[j] & 255;
    unsigned x = states[n_symbols & last];
    unsigned y = x & 2047;
    i32 symbol = slots[(context << 11) | y];
    unsigned entry = frequencies[(context << 6) | symbol];
    unsigned next = (entry & 4095) * (x >> 11) + y - (entry >> 12);
    /* Whether a word follows is hard to foresee: no branch. */
    unsigned takes = next < 65536;
    unsigned word = words[min(n_words_used, n_words)];
    states[n_symbols & last] = takes ? (next << 16) | word : next;
    n_words_used += takes;
    n_symbols++;
    details[j] = symbol - 31;
    has_raw |= (symbol == 0) | (context >= 72);
  }
  used[0] = n_symbols;
  used[1] = n_words_used;
  return has_raw;
}

/* Fill heights and errors of samples first ... stop - 1 of a row; `out` takes every step-th (R.6). */
EXPORT("finishRow")
void finish_row(i32 first, i32 stop, i32 *row, i32 m, i32 *own, i32 *error, i32 low, i32 high,
                i32 quantum, i32 error_shift) {
  const i32 *predicted = row, *whole = row + 6 * m, *contexts = row + 7 * m, *details = row + 8 * m;
  ROWS for (i32 j = first; j < stop; j++) {
    i32 change = details[j] * quantum;
    i32 height = min(max(contexts[j] & 256 ? whole[j] - change : whole[j] + change, low), high);
    own[j] = height;
    error[j] = min(magnitude((height << 6) - predicted[j]) >> error_shift, (1 << 18) - 1);
  }
}
