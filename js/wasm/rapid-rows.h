/*
 * Rows of method rapid (docs/format-rapid.md), as js/src/rapid-rows.js, rapid-wide.js and
 * rapid-streams.js have them; included for each kind of NUMBER that sums of heights are. Sums of
 * i32 wrap, as there (-fwrapv); those of doubles are exact. Pointers are to a row's first sample.
 */

#define EXPORT_OF(name) EXPORT(name SUFFIX)

/* What a row is computed in: arrays of m numbers each, one after the other, in this order. */
#define TAKE_ROW(row, m)                                                                    \
  NUMBER *predicted = row, *sum = row + m, *twist = row + 2 * m;                              \
  i32 *least = (i32 *)(row + 4 * m), *most = least + m, *expected = least + 2 * m

#define TAKE_CODED(row, m)                                                                    \
  NUMBER *details = row + 3 * m;                                                              \
  i32 *whole = (i32 *)(row + 4 * m) + 3 * m, *contexts = whole + m

EXPORT_OF("fillBends")
void NAMED(fill_bends)(i32 n, i32 s, const i32 *a, i32 *bends, i32 shift, i32 most) {
  ROWS for (i32 j = 0; j < n; j++) {
    const i32 *at = a + j;
    NUMBER across = LARGE at[-2] + at[2] - 4 * (LARGE at[-1] + at[1]) + 6 * LARGE at[0];
    NUMBER along = LARGE at[-2 * s] + at[2 * s] - 4 * (LARGE at[-s] + at[s]) + 6 * LARGE at[0];
    bends[j] = (i32)LEAST(SHIFTED(MAGNITUDE(across) + MAGNITUDE(along), shift), most);
  }
}

EXPORT_OF("predictHH")
void NAMED(predict_hh)(i32 n, i32 s, const i32 *a, const i32 *own, const i32 *error, const i32 *bends,
                const i32 *weights, const i32 *features, NUMBER *row, i32 m) {
  TAKE_ROW(row, m);
  COPY(NUMBER, w, weights, 19);
  COPY(i32, f, features, 9);
  ROWS for (i32 j = 0; j < n; j++) {
    const i32 *up = a + j - s, *at = a + j, *down = a + j + s, *low = a + j + 2 * s;
    NUMBER p = 32 + w[0] * up[-1] + w[1] * up[0] + w[2] * up[1] + w[3] * up[2];
    p += w[4] * at[-1] + w[5] * at[0] + w[6] * at[1] + w[7] * at[2];
    p += w[8] * down[-1] + w[9] * down[0] + w[10] * down[1] + w[11] * down[2];
    p += w[12] * low[-1] + w[13] * low[0] + w[14] * low[1] + w[15] * low[2];
    p += w[16] * own[j - s - 1] + w[17] * own[j - s] + w[18] * own[j - s + 1];
    predicted[j] = SHIFTED(p, 6);
    i32 b = at[1], c = down[0], d = down[1];
    least[j] = min(min(at[0], b), min(c, d));
    most[j] = max(max(at[0], b), max(c, d));
    sum[j] = LARGE at[0] + b + c + d;
    twist[j] = MAGNITUDE(LARGE at[0] + d - b - c);
    const i32 *north = error + j - s;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] +
                  f[6] * (bends[j] + bends[j + 1] + bends[j + s] + bends[j + s + 1]);
  }
}

EXPORT_OF("predictHL")
void NAMED(predict_hl)(i32 n, i32 s, const i32 *a, const i32 *hh, const i32 *own, const i32 *error_hh,
                const i32 *error, const i32 *bends, const i32 *weights, const i32 *features, NUMBER *row, i32 m) {
  TAKE_ROW(row, m);
  COPY(NUMBER, w, weights, 19);
  COPY(i32, f, features, 9);
  ROWS for (i32 j = 0; j < n; j++) {
    const i32 *at = a + j, *h = hh + j, *up = hh + j - s;
    NUMBER p = 32 + w[0] * at[-1] + w[1] * at[0] + w[2] * at[1] + w[3] * at[2];
    p += w[4] * at[-s] + w[5] * at[1 - s] + w[6] * at[s] + w[7] * at[s + 1];
    p += w[8] * up[-1] + w[9] * up[0] + w[10] * up[1] + w[11] * h[-1] + w[12] * h[0];
    p += w[13] * h[1] + w[14] * up[-s] + w[15] * h[s];
    p += w[16] * own[j - s - 1] + w[17] * own[j - s] + w[18] * own[j - s + 1];
    predicted[j] = SHIFTED(p, 6);
    NUMBER across = LARGE at[0] + at[1], along = LARGE up[0] + h[0];
    least[j] = min(min(at[0], at[1]), min(up[0], h[0]));
    most[j] = max(max(at[0], at[1]), max(up[0], h[0]));
    sum[j] = across + along;
    twist[j] = MAGNITUDE(across - along);
    const i32 *north = error + j - s, *e = error_hh + j, *e_up = error_hh + j - s;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] +
                  f[6] * (bends[j] + bends[j + 1]) + f[7] * (e_up[0] + e[0]) +
                  f[8] * (e_up[-1] + e[-1] + e_up[1] + e[1]);
  }
}

EXPORT_OF("predictLH")
void NAMED(predict_lh)(i32 n, i32 s, const i32 *a, const i32 *hh, const i32 *hl, const i32 *own,
                const i32 *error_hh, const i32 *error_hl, const i32 *error, const i32 *bends,
                const i32 *weights, const i32 *features, NUMBER *row, i32 m) {
  TAKE_ROW(row, m);
  COPY(NUMBER, w, weights, 23);
  COPY(i32, f, features, 9);
  ROWS for (i32 j = 0; j < n; j++) {
    const i32 *at = a + j, *down = a + j + s, *h = hh + j, *l = hl + j, *north_own = own + j - s;
    NUMBER p = 32 + w[0] * at[-s] + w[1] * at[0] + w[2] * down[0] + w[3] * down[s];
    p += w[4] * at[-1] + w[5] * at[1] + w[6] * down[-1] + w[7] * down[1];
    p += w[8] * north_own[-1] + w[9] * north_own[0] + w[10] * north_own[1] + w[11] * h[-2];
    p += w[12] * h[-1] + w[13] * h[0] + w[14] * h[1] + w[15] * h[-s - 1] + w[16] * h[-s];
    p += w[17] * h[s - 1] + w[18] * h[s] + w[19] * l[-1] + w[20] * l[0];
    p += w[21] * l[s - 1] + w[22] * l[s];
    predicted[j] = SHIFTED(p, 6);
    NUMBER across = LARGE at[0] + down[0], along = LARGE h[-1] + h[0];
    least[j] = min(min(at[0], down[0]), min(h[-1], h[0]));
    most[j] = max(max(at[0], down[0]), max(h[-1], h[0]));
    sum[j] = across + along;
    twist[j] = MAGNITUDE(across - along);
    const i32 *north = error + j - s, *e = error_hh + j, *g = error_hl + j;
    expected[j] = f[1] * north[0] + f[2] * (north[-1] + north[1]) + f[3] * north[-s] +
                  f[6] * (bends[j] + bends[j + s]) +
                  f[7] * (e[-1] + e[0] + g[-1] + g[0] + g[s - 1] + g[s]) +
                  f[8] * (e[-s - 1] + e[-s] + e[s - 1] + e[s]);
  }
}

EXPORT_OF("fillContexts")
void NAMED(fill_contexts)(i32 n, const i32 *f, NUMBER *row, i32 m, i32 range_shift, i32 most_range,
                          i32 is_fine, i32 is_by_reach, i32 side_shift, i32 side_scale,
                          i32 far_scale, i32 end_shift) {
  TAKE_ROW(row, m);
  i32 *whole = least + 3 * m, *contexts = whole + m;
  const i32 of_const = f[0], of_range = f[4], of_twist = f[5];
  ROWS for (i32 j = 0; j < n; j++) {
    NUMBER low = least[j], high = most[j];
    NUMBER p = LEAST(MOST(predicted[j], low * 64), high * 64);
    predicted[j] = p;
    whole[j] = (i32)SHIFTED(p + 32, 6);
    i32 e = expected[j] + of_const + of_range * (i32)LEAST(SHIFTED(high - low, range_shift), most_range) +
            of_twist * (i32)LEAST(SHIFTED(twist[j], range_shift), most_range);
    expected[j] = e >> 4;
  }
  i32 first = 0; /* the first bin that has not been dealt with */
  if (is_fine) {
    ROWS for (i32 j = 0; j < n; j++) {
      i32 bin = bin_of(expected[j]);
      i32 side = (i32)(predicted[j] - (NUMBER)whole[j] * 64);
      i32 near = min((magnitude(side) * side_scale) >> 16, 3);
      contexts[j] = (4 * bin + (bin < 16 ? near : 0)) | (side < 0 ? 256 : 0);
    }
    if (!is_by_reach) return;
    first = 16;
  }
  if (is_by_reach) {
    ROWS for (i32 j = 0; j < n; j++) {
      i32 e = expected[j], bin = bin_of(e); /* e below 2^27: twelve times it fit */
      NUMBER side = sum[j] * 16 - predicted[j];
      NUMBER above = (NUMBER)most[j] * 64 - predicted[j], below = predicted[j] - (NUMBER)least[j] * 64;
      NUMBER far = side < 0 ? above : below;
      i32 x = ((i32)LEAST(SHIFTED(far, side_shift), (1 << 20) - 1) * far_scale) >> end_shift;
      i32 reach = (x > 2 * e ? 1 : 0) + (x > 6 * e ? 1 : 0) + (x > 12 * e ? 1 : 0);
      contexts[j] = bin < first ? contexts[j] : (4 * bin + reach) | (side < 0 ? 256 : 0);
    }
    return;
  }
  ROWS for (i32 j = 0; j < n; j++) {
    i32 e = expected[j]; /* below 2^27: eleven times it fit */
    NUMBER side = sum[j] * 16 - predicted[j];
    i32 x = ((i32)LEAST(SHIFTED(MAGNITUDE(side), side_shift), (1 << 20) - 1) * far_scale) >> end_shift;
    i32 far = (x > e ? 1 : 0) + (4 * x > 11 * e ? 1 : 0) + (x > 6 * e ? 1 : 0);
    contexts[j] = (4 * bin_of(e) + far) | (side < 0 ? 256 : 0);
  }
}

/* Read the raw bits of a row's details (R.8). */
static void NAMED(read_raw)(i32 first, i32 stop, NUMBER *row, i32 m, const u8 *valid, i32 step,
                            const u8 *raw, i32 n_raw, double most, i32 *used) {
  TAKE_CODED(row, m);
  (void)whole;
  for (i32 j = first; j < stop; j++) {
    if (valid && !valid[j * step]) continue;
    i32 n = ((contexts[j] & 255) >> 3) - 8;
    double detail = details[j];
    if (detail == -31) {
      detail = read_bits(raw, n_raw, used, 24);
      detail += read_bits(raw, n_raw, used, 8) * 16777216.0;
      detail -= read_bits(raw, n_raw, used, 1) * 4294967296.0;
    } else if (n > 0) {
      detail = detail * (1 << n) + read_bits(raw, n_raw, used, n);
    } else {
      continue;
    }
    detail = detail < -most ? -most : detail > most ? most : detail;
    details[j] = (NUMBER)detail;
  }
}

/*
 * Read the details first ... stop - 1 of a row; of each, `valid` is at every step-th place. `used`
 * counts symbols, words and raw bits; words[n_words] stands for all beyond the end (R.8).
 */
EXPORT_OF("readDetails")
void NAMED(read_details)(i32 first, i32 stop, NUMBER *row, i32 m, const u8 *valid, i32 step,
                         const u8 *slots, const i32 *frequencies, u32 *states, i32 last,
                         const unsigned short *words, i32 n_words, const u8 *raw, i32 n_raw,
                         double most, i32 *used) {
  TAKE_CODED(row, m);
  (void)whole;
  i32 n_symbols = used[0], n_words_used = used[1], has_raw = 0;
  for (i32 j = first; j < stop; j++) {
    if (valid && !valid[j * step]) {
      details[j] = 0;
      continue;
    }
    i32 context = contexts[j] & 255;
    u32 x = states[n_symbols & last];
    u32 y = x & 2047;
    i32 symbol = slots[(context << 11) | y];
    u32 entry = frequencies[(context << 6) | symbol];
    u32 next = (entry & 4095) * (x >> 11) + y - (entry >> 12);
    /* Whether a word follows is hard to foresee: no branch. */
    u32 takes = next < 65536;
    u32 word = words[min(n_words_used, n_words)];
    states[n_symbols & last] = takes ? (next << 16) | word : next;
    n_words_used += takes;
    n_symbols++;
    details[j] = symbol - 31;
    has_raw |= (symbol == 0) | (context >= 72);
  }
  used[0] = n_symbols;
  used[1] = n_words_used;
  if (has_raw) NAMED(read_raw)(first, stop, row, m, valid, step, raw, n_raw, most, used);
}

/* Fill heights and errors of samples first ... stop - 1 of a row; `out` takes every step-th (R.6). */
EXPORT_OF("finishRow")
void NAMED(finish_row)(i32 first, i32 stop, NUMBER *row, i32 m, i32 *own, i32 *error, i32 low,
                       i32 high, NUMBER quantum, i32 error_shift, i32 *out, i32 step, i32 origin) {
  TAKE_CODED(row, m);
  const NUMBER *predicted = row;
  ROWS for (i32 j = first; j < stop; j++) {
    NUMBER change = details[j] * quantum;
    NUMBER height = contexts[j] & 256 ? whole[j] - change : whole[j] + change;
    i32 held = (i32)LEAST(MOST(height, (NUMBER)low), (NUMBER)high);
    own[j] = held;
    NUMBER distance = MAGNITUDE((NUMBER)held * 64 - predicted[j]);
    error[j] = (i32)LEAST(SHIFTED(distance, error_shift), (1 << 18) - 1);
  }
  for (i32 j = first; j < stop; j++) out[j * step] = own[j] + origin;
}

#undef EXPORT_OF
#undef TAKE_ROW
#undef TAKE_CODED
#undef NUMBER
#undef ROWS
#undef NAMED
#undef SUFFIX
#undef LARGE
#undef LEAST
#undef MOST
#undef MAGNITUDE
#undef SHIFTED
