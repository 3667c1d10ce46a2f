/* Method predictive (docs/format-predictive.md, P.n). */
#include "border.h"
#include "steps.h"
#include "tables.h"

enum {
  HH, HL, LH,
  N_DETAIL_MODELS = 22931,
  N_MIXERS = 22,
  N_FEATURES = 18,
  MOST_SETS = 16,
  OUTSIDE = 5,   /* lattice places farther outside are never read */
  SMALL = 1024   /* lattices of fewer samples have no headers of planes */
};
static const int64_t MOST = (int64_t)1 << 30;
static const int N_TAPS_OF[3] = {20, 20, 24};
/* Of a stencil: the taps of the core, its first first. */
static const int CORE_TAPS[3][4] = {{9, 10, 13, 14}, {4, 5, 8, 9}, {4, 5, 8, 9}};

typedef struct predictive_tables {
  int n_sets[3], n_classes[3];
  int16_t stencils[3][MOST_SETS][MOST_TAPS];
  int16_t weights[3][4][N_FEATURES];
  model models[N_DETAIL_MODELS + N_BORDER_MODELS]; /* of details, then of the border */
  eighths eighths;
} predictive_tables;

/* ---- Tables of a file (P.9, P.10) ---- */

static twz_status read_plane(coder *c, model *models, predictive_tables *t, int plane, twz_error *error) {
  int n_new = (int)raw_bits(c, 4);
  REQUIRE(n_new + PREDICTIVE_SETS <= MOST_SETS, error, "parameters: %d stencils beside those of the format", n_new);
  for (int i = 0; i < n_new; i++) {
    int base = (int)raw_bits(c, 4);
    REQUIRE(base < PREDICTIVE_SETS, error, "parameters: stencil %d does not exist", base);
    int16_t *own = t->stencils[plane][t->n_sets[plane]++];
    memcpy(own, t->stencils[plane][base], sizeof t->stencils[plane][base]);
    TRY(read_changed_stencil(c, models, N_TAPS_OF[plane], CORE_TAPS[plane], own, error));
  }
  if (!raw_bits(c, 1)) return TWZ_OK;
  for (int i = 0; i < N_FEATURES; i++) {
    int64_t weight = magnitude(c, models + 92, models + 92 + 14, 0);
    REQUIRE(weight <= 4096, error, "parameters: a weight of a feature above 4096");
    t->weights[plane][3][i] = (int16_t)weight;
  }
  t->n_classes[plane] = 4;
  return TWZ_OK;
}

static twz_status read_parameters(const twz_file *f, predictive_tables *t, const uint8_t *bytes, size_t n, twz_error *error) {
  if (n == 0) return TWZ_OK;
  REQUIRE_KNOWN(bytes[0] == 1, error, "parameters of layout %d, which a newer release may know", bytes[0]);
  model models[138];
  for (int i = 0; i < 138; i++) models[i] = FRESH_MODEL;
  coder c;
  coder_start(&c, bytes + 1, n - 1, f->rates);
  for (int plane = HH; plane <= LH; plane++) TRY(read_plane(&c, models, t, plane, error));
  return coder_end(&c, "parameters", error);
}

twz_status predictive_tables_new(twz_file *f, const uint8_t *parameters, size_t n, twz_error *error) {
  predictive_tables *t = f->predictive = twz_allocate_zeros(&f->allocator, sizeof *t);
  if (!t) return twz_no_memory(error, sizeof *t);
  TRY(read_starts(f, twz_predictive_starts, twz_predictive_starts_size, t->models, N_DETAIL_MODELS + N_BORDER_MODELS, error));
  fill_eighths(&t->eighths);
  for (int plane = HH; plane <= LH; plane++) {
    t->n_sets[plane] = PREDICTIVE_SETS;
    t->n_classes[plane] = 3;
    memcpy(t->stencils[plane], twz_predictive_stencils[plane], sizeof twz_predictive_stencils[plane]);
    memcpy(t->weights[plane], twz_predictive_weights[plane], sizeof twz_predictive_weights[plane]);
  }
  return read_parameters(f, t, parameters, n, error);
}

/* ---- A unit ---- */

typedef struct decoding {
  const job *job;
  const predictive_tables *tables;
  layer *out;
  coder coder;
  int is_mixed, is_clamped;
  int32_t n; /* the step */
  int32_t z_min, z_max;
  step_scale scale;
  model *details;
  border border;
  int64_t mixers[N_MIXERS][2];
  /* A lattice, with margins: heights, errors, activities, curvatures. */
  int32_t n_rows, n_cols, stride;
  ptrdiff_t lattice_pitch;
  int32_t *values, *errors, *activity, *bends, *own_errors;
} decoding;

static ALWAYS_INLINE int mean_bit(decoding *d, int b, int h) {
  if (!d->is_mixed) return adaptive_bit(&d->coder, d->details + b);
  model first = d->details[b], second = d->details[h];
  int bit = split(&d->coder, (((first >> 8) + (second >> 8)) >> 7) | 1);
  d->details[b] = learned(&d->coder, first, bit);
  d->details[h] = learned(&d->coder, second, bit);
  return bit;
}

static ALWAYS_INLINE int mixed_bit(decoding *d, int b, int h, int mixer) {
  if (!d->is_mixed) return adaptive_bit(&d->coder, d->details + b);
  model first = d->details[b], second = d->details[h];
  int64_t x = twz_logits[first >> 20], y = twz_logits[second >> 20], *v = d->mixers[mixer];
  int64_t sum = clamp_i64((v[0] * x + v[1] * y) >> 19, -352, 351), m = twz_mixed[sum + 352];
  int bit = split(&d->coder, (uint32_t)m);
  d->details[b] = learned(&d->coder, first, bit);
  d->details[h] = learned(&d->coder, second, bit);
  v[0] += ((32768 - m * x) >> 16) + (bit ? x : 0);
  v[1] += ((32768 - m * y) >> 16) + (bit ? y : 0);
  return bit;
}

/* ---- Shared lines and what a unit begins with (P.2 ... P.4) ---- */

static void predict_line(int64_t *v, int32_t length, int64_t *predicted) {
  int32_t m = (length + 1) >> 1;
  for (int32_t i = 0; i < length; i++) {
    int32_t k = i >> 1;
    if (i % 2 == 0) {
      predicted[i] = shift_right(v[k] + 1, 1);
    } else if (k + 1 == m) {
      predicted[i] = shift_right(3 * v[k] - v[max_i32(k - 1, 0)] + 2, 2);
    } else {
      int64_t before = k > 0 ? v[k - 1] : v[1], after = k + 2 < m ? v[k + 2] : v[m - 2];
      predicted[i] = shift_right(9 * (v[k] + v[k + 1]) - before - after + 16, 5);
    }
  }
}

/* Samples of even row and column are the parent's (P.2). */
static void take_parents(decoding *d) {
  const parent *p = &d->job->parent;
  int32_t top = line_above(d->out->rows.core_first, 0, p->first_row, p->n_rows);
  int32_t left = line_above(d->out->cols.core_first, 0, p->first_col, p->n_cols);
  for (int32_t r = 0; r < d->out->rows.n_core; r += 2) {
    for (int32_t c = 0; c < d->out->cols.n_core; c += 2) {
      d->out->heights[core_at(d->out, r, c)] = parent_height(p, top + r / 2, left + c / 2);
    }
  }
}

/* Returns the stride of the corners. */
static int32_t decode_root_corners(decoding *d) {
  int32_t stride = 1, n_rows = d->out->rows.n_core, n_cols = d->out->cols.n_core;
  while (stride < max_i32(n_rows, n_cols) - 1) stride *= 2;
  for (int32_t r = 0; r < n_rows; r += stride) {
    for (int32_t c = 0; c < n_cols; c += stride) {
      size_t at = core_at(d->out, r, c);
      border_put(&d->border, at, d->n >> 1, is_valid_at(d->out, at) ? border_symbol(&d->border, 2, 16) : 0);
    }
  }
  return stride;
}

/* ---- Lattices (P.5) ---- */

static int32_t fold(int32_t i, int32_t n) {
  if (n == 1) return 0;
  int32_t period = 2 * (n - 1), inside = (i % period + period) % period;
  return min_i32(inside, period - inside);
}

static ptrdiff_t lattice_at(const decoding *d, int32_t r, int32_t c) {
  return (r + OUTSIDE) * d->lattice_pitch + c + OUTSIDE;
}

/* Make a plane of an array readable outside. */
static void mirror(const decoding *d, int32_t *array, int down, int right) {
  int32_t first = right ? -OUTSIDE : 1 - OUTSIDE; /* OUTSIDE is odd */
  for (int32_t r = down; r < d->n_rows; r += 2) {
    for (int32_t c = first; c < d->n_cols + OUTSIDE; c += 2) {
      if (c < 0 || c >= d->n_cols) array[lattice_at(d, r, c)] = array[lattice_at(d, r, fold(c, d->n_cols))];
    }
  }
  for (int32_t r = down ? -OUTSIDE : 1 - OUTSIDE; r < d->n_rows + OUTSIDE; r += 2) {
    if (r >= 0 && r < d->n_rows) continue;
    int32_t *to = array + lattice_at(d, r, 0);
    const int32_t *from = array + lattice_at(d, fold(r, d->n_rows), 0);
    for (int32_t c = first; c < d->n_cols + OUTSIDE; c += 2) to[c] = from[c];
  }
}

/* Means that stand for the samples of an empty plane. */
static void fill_means(const decoding *d, int down, int right) {
  for (int32_t r = down ? -OUTSIDE : 1 - OUTSIDE; r < d->n_rows + OUTSIDE; r += 2) {
    for (int32_t c = right ? -OUTSIDE : 1 - OUTSIDE; c < d->n_cols + OUTSIDE; c += 2) {
      int64_t sum = 0;
      for (int i = 0; i < 4; i++) { /* of HL and LH the same two samples twice: (2 (a + b) + 2) >> 2 */
        int32_t row = fold(r + (i & 2 ? down : -down), d->n_rows), col = fold(c + (i & 1 ? right : -right), d->n_cols);
        sum += d->values[lattice_at(d, row, col)];
      }
      d->values[lattice_at(d, r, c)] = (int32_t)shift_right(sum + 2, 2);
    }
  }
}

static void fill_bends(const decoding *d) {
  ptrdiff_t up = 2 * d->lattice_pitch;
  for (int32_t r = 0; r < d->n_rows; r += 2) {
    for (int32_t c = 0; c < d->n_cols; c += 2) {
      const int32_t *a = d->values + lattice_at(d, r, c);
      int64_t across = (int64_t)a[-4] - 4 * (int64_t)a[-2] + 6 * (int64_t)a[0] - 4 * (int64_t)a[2] + a[4];
      int64_t along = (int64_t)a[-2 * up] - 4 * (int64_t)a[-up] + 6 * (int64_t)a[0] - 4 * (int64_t)a[up] + a[2 * up];
      d->bends[lattice_at(d, r, c)] = (int32_t)min_i64(abs_i64(across) + abs_i64(along), INT32_MAX);
    }
  }
  mirror(d, d->bends, 0, 0);
}

static int is_empty(const decoding *d, int down, int right) {
  return (down && d->n_rows == 1) || (right && d->n_cols == 1);
}

static void load_lattice(decoding *d, int32_t stride) {
  d->stride = stride;
  d->n_rows = (d->out->rows.n_core - 1) / stride + 1;
  d->n_cols = (d->out->cols.n_core - 1) / stride + 1;
  d->lattice_pitch = d->n_cols + 2 * OUTSIDE;
  size_t n = sizeof(int32_t) * (size_t)((d->n_rows + 2 * OUTSIDE) * d->lattice_pitch);
  memset(d->values, 0, n);
  memset(d->errors, 0, n);
  memset(d->activity, 0, n);
  memset(d->bends, 0, n);
  for (int32_t r = 0; r < d->n_rows; r += 2) {
    for (int32_t c = 0; c < d->n_cols; c += 2) {
      d->values[lattice_at(d, r, c)] = d->out->heights[core_at(d->out, r * stride, c * stride)];
    }
  }
  mirror(d, d->values, 0, 0);
  for (int parity = 1; parity < 4; parity++) {
    if (is_empty(d, parity >> 1, parity & 1)) fill_means(d, parity >> 1, parity & 1);
  }
  fill_bends(d);
}

/* ---- A plane (P.5 ... P.7) ---- */

typedef struct plane {
  int32_t n_rows, n_cols;
  ptrdiff_t taps[MOST_TAPS], core[4];
  const int16_t *stencil, *weights;
} plane;

/* What is known of a sample before its detail. */
typedef struct sample {
  int64_t p, w;
  int64_t six[6]; /* the sorted core, then the heights at W and N */
} sample;

static ALWAYS_INLINE int rho(const decoding *d, int64_t distance, int64_t e) {
  const eighths *t = &d->tables->eighths;
  return min_i32((lg(t, distance + e + 77) - lg(t, e + 77)) >> 2, 7);
}

static ALWAYS_INLINE int mu(const decoding *d, int64_t distance, int64_t e) {
  const eighths *t = &d->tables->eighths;
  int64_t g = max_i64(e, 128), s = steps(&d->scale, abs_i64(distance), 2);
  int size = min_i32((lg(t, 2 * s + g) - lg(t, g)) >> 2, 4);
  return distance > 0 && s > 0 ? 4 + size : 4 - size;
}

/* v of P.7; ahead: t' of the six, -1 where it does not count. */
static int64_t decode_size(decoding *d, int beta, int reach, int kappa, const int64_t *ahead) {
  int first = 6179 + 14 * (8 * beta + reach), mixer = 11 + (beta >> 2), ones = 0;
  for (; ones < 14; ones++) {
    int beyond = 0, here = 0;
    for (int k = 0; k < 6; k++) {
      beyond += ahead[k] > ones;
      here += ahead[k] == ones;
    }
    int h = 11107 + 18 * (14 * beta + ones) + 3 * min_i32(beyond, 5) + min_i32(here, 2);
    if (!mixed_bit(d, first + ones, h, mixer)) break;
  }
  int64_t upper = ones;
  if (ones == 14) {
    int n_bits = 0;
    while (n_bits < 31 && adaptive_bit(&d->coder, d->details + 22899 + n_bits)) n_bits++;
    upper = 13 + ((int64_t)1 << n_bits) + (int64_t)raw_bits(&d->coder, n_bits);
  }
  int64_t low = 0;
  int at = 22195 + 16 * beta + 4 * min_i32(ones, 3);
  for (int k = 0; k < kappa && k < 2; k++) {
    int bit = adaptive_bit(&d->coder, d->details + at);
    low = 2 * low + bit;
    if (k == 0) at += 1 + bit;
  }
  int rest = max_i32(kappa - 2, 0);
  return (upper << kappa) + (low << rest) + (int64_t)raw_bits(&d->coder, rest);
}

/* The detail q (P.7). */
static ALWAYS_INLINE int64_t decode_detail(decoding *d, const sample *z, int64_t e) {
  const int64_t *six = z->six;
  int64_t half = d->n >> 1, phi = z->p - 64 * z->w;
  int beta = min_i32(max_i32(((lg(&d->tables->eighths, e) - 24) >> 2) + 1, 0), 43), up = 0, down = 0;
  for (int k = 0; k < 6; k++) {
    up += six[k] > z->w + half;
    down += six[k] < z->w - half;
  }
  int range = rho(d, steps(&d->scale, six[3] - six[0], 8), e);
  int side = (int)min_i64(steps(&d->scale, abs_i64(phi), -3), 3), most = min_i32(min_i32(up, down), 3);
  if (!mean_bit(d, 4 * (8 * beta + range) + side, 1408 + 4 * (7 * beta + 6 - up - down) + most)) return 0;
  int epsilon = (beta >= 7) + (beta >= 10) + (beta >= 13) + (beta >= 16); /* 50, 61, 72, 84 < 24 + 4 beta */
  int slope = (int)min_i64((steps(&d->scale, 6 * abs_i64(phi), -5) + 1) >> 1, 3);
  int sigma = phi > 0 ? 3 + slope : 3 - slope;
  int inner = mu(d, (six[1] + six[2]) * 32 - z->p, e), outer = mu(d, (six[0] + six[3]) * 32 - z->p, e);
  int is_up = mixed_bit(d, 2640 + 9 * (9 * (7 * epsilon + sigma) + inner) + outer, 5475 + 8 * (8 * (beta >> 2) + up) + down,
                        beta >> 2);
  int64_t room = is_up ? 64 * six[3] - z->p : z->p - 64 * six[0];
  int reach = rho(d, steps(&d->scale, max_i64(room, 0), 2), e);
  int kappa = beta ? max_i32(0, ((24 + 4 * (beta - 1)) >> 3) - 9) : 0;
  int64_t ahead[6];
  for (int k = 0; k < 6; k++) {
    int64_t distance = is_up ? six[k] - z->w : z->w - six[k];
    int64_t t = distance > 0 ? steps(&d->scale, distance + half, 0) : 0;
    ahead[k] = t > 0 ? min_i64((t - 1) >> kappa, 15) : -1;
  }
  int64_t size = 1 + decode_size(d, beta, reach, kappa, ahead);
  return is_up ? size : -size;
}

static ALWAYS_INLINE int64_t bend_of(const int32_t *v, ptrdiff_t step) {
  return abs_i64((int64_t)v[-3 * step] - v[-step] - v[step] + v[3 * step]);
}

/* D of P.6. */
static ALWAYS_INLINE int64_t distance_of(const decoding *d, const plane *p, int which, ptrdiff_t at, const sample *z,
                                         int64_t off) {
  const int16_t *w = p->weights;
  const int32_t *v = d->values + at, *bends = d->bends + at;
  ptrdiff_t up = d->lattice_pitch;
  int64_t a = v[p->core[0]], b = v[p->core[1]], c = v[p->core[2]], e = v[p->core[3]], bent, twist, lines;
  if (which == HH) {
    bent = (int64_t)bends[p->core[0]] + bends[p->core[1]] + bends[p->core[2]] + bends[p->core[3]];
    twist = a + e - b - c;
    lines = bend_of(v - up, 1) + bend_of(v + up, 1) + bend_of(v - 1, up) + bend_of(v + 1, up);
  } else {
    ptrdiff_t beside = which == HL ? 1 : up;
    bent = (int64_t)bends[-beside] + bends[beside];
    twist = a + b - c - e;
    lines = bend_of(v, 1) + bend_of(v, up);
  }
  const int64_t *six = z->six;
  return 64 * (w[8] * bent + w[9] * (six[3] - six[0]) + w[12] * abs_i64(twist) + w[13] * lines) +
         w[10] * abs_i64((six[1] + six[2]) * 32 - z->p) + w[11] * abs_i64((six[0] + six[3]) * 32 - z->p) + w[14] * off;
}

/* What errors and activities add to E (P.6); own: errors of the plane, n a row. */
static ALWAYS_INLINE int64_t total_of(const decoding *d, const plane *p, int which, ptrdiff_t at, const int32_t *own,
                                      ptrdiff_t n, int is_first) {
  const int16_t *w = p->weights;
  const int32_t *e = d->errors + at, *v = d->activity + at;
  ptrdiff_t up = d->lattice_pitch;
  int64_t total = w[15] + (int64_t)w[0] * own[-1] + (int64_t)w[1] * own[-2] + (int64_t)w[2] * own[-n] +
                  (int64_t)w[3] * own[-n - 1] + (int64_t)w[4] * own[1 - n] + (int64_t)w[5] * own[-2 * n];
  if (!is_first) total += (int64_t)w[16] * v[-2 * up];
  if (which == HL) {
    total += (int64_t)w[6] * (e[-up] + e[up]) + (int64_t)w[17] * v[up] +
             (int64_t)w[7] * (e[-up - 2] + e[2 - up] + e[up - 2] + e[up + 2]);
  } else if (which == LH) {
    total += (int64_t)w[6] * (e[-1] + e[1] + e[-up - 1] + e[1 - up] + e[up - 1] + e[up + 1]) +
             (int64_t)w[7] * (e[-2 * up - 1] + e[1 - 2 * up] + e[2 * up - 1] + e[2 * up + 1]) +
             (int64_t)w[17] * (v[1] + v[up + 1]);
  }
  return total;
}

static ALWAYS_INLINE void sort_two(int64_t *x, int a, int b) {
  int64_t low = min_i64(x[a], x[b]), high = max_i64(x[a], x[b]);
  x[a] = low;
  x[b] = high;
}

static int64_t core_mean(const decoding *d, const plane *p, ptrdiff_t at) {
  int64_t sum = 2;
  for (int k = 0; k < 4; k++) sum += d->values[at + p->core[k]];
  return shift_right(sum, 2);
}

static ALWAYS_INLINE void decode_row(decoding *d, const plane *p, int which, int32_t i, ptrdiff_t first, size_t place) {
  ptrdiff_t n = p->n_cols + 3;
  int32_t *own = d->own_errors + (i + 2) * n + 2, *heights = d->out->heights;
  const int n_taps = which == LH ? 24 : 20;
  for (int32_t j = 0; j < p->n_cols; j++, place += 2 * (size_t)d->stride) {
    ptrdiff_t at = first + 2 * j;
    int32_t *v = d->values + at;
    sample z;
    z.p = 32;
    for (int k = 0; k < n_taps; k++) z.p += (int64_t)p->stencil[k] * v[p->taps[k]];
    z.p = shift_right(z.p, 6);
    for (int k = 0; k < 4; k++) z.six[k] = v[p->core[k]];
    sort_two(z.six, 0, 1);
    sort_two(z.six, 2, 3);
    sort_two(z.six, 0, 2);
    sort_two(z.six, 1, 3);
    sort_two(z.six, 1, 2);
    int64_t off = abs_i64(z.p - 16 * (z.six[0] + z.six[1] + z.six[2] + z.six[3]));
    if (d->is_clamped) z.p = clamp_i64(z.p, 64 * z.six[0], 64 * z.six[3]);
    z.p = clamp_i64(z.p, 64 * (int64_t)d->z_min, 64 * (int64_t)d->z_max);
    z.w = shift_right(z.p + 32, 6);
    int known = d->border.known[place], valid = is_valid_at(d->out, place);
    int64_t height = z.w;
    if (known) {
      height = heights[place];
    } else if (valid) {
      int64_t total = total_of(d, p, which, at, own + j, n, i == 0) +
                      steps(&d->scale, distance_of(d, p, which, at, &z, off), -1);
      z.six[4] = v[-2];
      z.six[5] = v[-2 * d->lattice_pitch];
      int64_t q = decode_detail(d, &z, min_i64(total >> 6, ((int64_t)1 << 28) - 1));
      int64_t most = 2 * MOST / d->n + 2;
      height = clamp_i64(z.w + clamp_i64(q, -most, most) * d->n, d->z_min, d->z_max);
    }
    if (!known) height = corrected(d->job, place, height, d->z_min, d->z_max);
    heights[place] = *v = (int32_t)height;
    int64_t error = known || valid ? min_i64(steps(&d->scale, abs_i64(64 * height - z.p), -1), 32767) : 0;
    own[j] = d->errors[at] = (int32_t)error;
  }
}

static void fill_activity(const decoding *d, const plane *p, int32_t i, ptrdiff_t first) {
  const int32_t *own = d->own_errors + (i + 2) * (ptrdiff_t)(p->n_cols + 3) + 2;
  for (int32_t j = 0; j < p->n_cols; j++) {
    int32_t *v = d->activity + first + 2 * j, u = 0;
    if (i > 0) {
      const int32_t *above = v - 2 * d->lattice_pitch;
      u = (j > 0 ? above[-2] : above[0]) + 2 * above[0] + (j < p->n_cols - 1 ? above[2] : above[0]);
    }
    *v = own[j - 1] + 2 * own[j] + own[j + 1] + ((3 * u) >> 4);
  }
}

static ALWAYS_INLINE void decode_rows(decoding *d, const plane *p, int which, int down, int right) {
  ptrdiff_t n = p->n_cols + 3, start = lattice_at(d, down, right), up = 2 * d->lattice_pitch;
  ptrdiff_t end = start + 2 * (p->n_cols - 1);
  memset(d->own_errors, 0, sizeof(int32_t) * 2 * (size_t)n);
  for (ptrdiff_t at = start; at <= end; at += 2) d->values[at - up] = (int32_t)core_mean(d, p, at);
  d->values[start - up - 2] = (int32_t)core_mean(d, p, start);
  d->values[end - up + 2] = (int32_t)core_mean(d, p, end);
  for (int32_t i = 0; i < p->n_rows && !coder_is_cut(&d->coder); i++) {
    ptrdiff_t first = start + i * up, last = first + 2 * (p->n_cols - 1);
    int32_t *own = d->own_errors + (i + 2) * n + 2;
    own[-1] = own[-2] = i > 0 ? own[-n] : 0;
    d->values[first - 2] = (int32_t)core_mean(d, p, first);
    d->values[last + 2] = (int32_t)core_mean(d, p, last);
    decode_row(d, p, which, i, first, core_at(d->out, (2 * i + down) * d->stride, right * d->stride));
    own[p->n_cols] = own[p->n_cols - 1];
    fill_activity(d, p, i, first);
  }
}

static void place_taps(const decoding *d, plane *p, int which) {
  static const int8_t OWN[4][2] = {{0, -2}, {-2, 0}, {-2, -2}, {-2, 2}};
  static const int8_t OTHERS[16][2] = {{0, -1}, {0, 1}, {0, -3}, {0, 3},  {-1, 0}, {1, 0},  {-1, -2}, {-1, 2},
                                       {1, -2}, {1, 2}, {-2, -1}, {-2, 1}, {2, -1}, {2, 1}, {-3, 0},  {3, 0}};
  static const int8_t DIAGONAL[4][2] = {{-1, -1}, {-1, 1}, {1, -1}, {1, 1}};
  ptrdiff_t up = d->lattice_pitch;
  for (int k = 0; k < 4; k++) p->taps[k] = OWN[k][0] * up + OWN[k][1];
  for (int k = 0; k < 16; k++) {
    p->taps[4 + k] = which == HH   ? (2 * (k / 4) - 3) * up + 2 * (k % 4) - 3
                     : which == HL ? OTHERS[k][0] * up + OTHERS[k][1]
                                   : OTHERS[k][1] * up + OTHERS[k][0];
  }
  for (int k = 0; k < 4; k++) p->taps[20 + k] = DIAGONAL[k][0] * up + DIAGONAL[k][1];
  for (int k = 0; k < 4; k++) p->core[k] = p->taps[CORE_TAPS[which][k]];
}

/* Read the header of a plane and decode it. */
static twz_status decode_plane(decoding *d, int which, int down, int right, twz_error *error) {
  int set = 0, class = 2;
  if ((int64_t)d->n_rows * d->n_cols >= SMALL) {
    int number = (int)raw_bits(&d->coder, 6);
    set = number >> 2;
    class = number & 3;
  }
  const predictive_tables *t = d->tables;
  REQUIRE(set < t->n_sets[which] && class < t->n_classes[which], error, "stencil %d or class %d of a plane does not exist",
          set, class);
  plane p;
  p.n_rows = (d->n_rows + 1 - down) >> 1;
  p.n_cols = (d->n_cols + 1 - right) >> 1;
  p.stencil = t->stencils[which][set];
  p.weights = t->weights[which][class];
  place_taps(d, &p, which);
  if (which == HH) {
    decode_rows(d, &p, HH, 1, 1);
  } else if (which == HL) {
    decode_rows(d, &p, HL, 0, 1);
  } else {
    decode_rows(d, &p, LH, 1, 0);
  }
  mirror(d, d->values, down, right);
  mirror(d, d->errors, down, right);
  mirror(d, d->activity, down, right);
  return TWZ_OK;
}

twz_status decode_predictive(const job *j, const reader *bytes, scratch *s, twz_error *error) {
  const header *h = &j->file->header;
  decoding d;
  memset(&d, 0, sizeof d);
  REQUIRE(bytes->n >= 1, error, "a payload without a byte of method predictive");
  REQUIRE(bytes->bytes[0] < 4, error, "flags %d of method predictive", bytes->bytes[0]);
  d.job = j;
  d.out = j->out;
  d.tables = j->file->predictive;
  d.is_mixed = bytes->bytes[0] & 1;
  d.is_clamped = bytes->bytes[0] >> 1;
  d.n = h->step;
  d.z_min = h->z_min;
  d.z_max = h->z_max;
  d.scale = step_scale_of(d.n);
  for (int i = 0; i < N_MIXERS; i++) d.mixers[i][0] = d.mixers[i][1] = 32768;
  coder_start(&d.coder, bytes->bytes + 1, bytes->n - 1, j->file->rates);

  size_t n_rows = (size_t)d.out->rows.n_core + 2 * OUTSIDE, n_cols = (size_t)d.out->cols.n_core + 2 * OUTSIDE;
  size_t n_bytes = 5 * n_rows * n_cols * 4 + N_DETAIL_MODELS * sizeof(model) + 6 * SCRATCH_ALIGN;
  TRY(scratch_reserve(s, n_bytes + border_bytes(j), error));
  d.values = scratch_take(s, n_rows * n_cols * 4);
  d.errors = scratch_take(s, n_rows * n_cols * 4);
  d.activity = scratch_take(s, n_rows * n_cols * 4);
  d.bends = scratch_take(s, n_rows * n_cols * 4);
  d.own_errors = scratch_take(s, n_rows * n_cols * 4);
  d.details = scratch_take(s, N_DETAIL_MODELS * sizeof(model));
  memcpy(d.details, d.tables->models, N_DETAIL_MODELS * sizeof(model));
  const border shared = {.job = j, .coder = &d.coder, .step = d.n, .predict = predict_line};
  d.border = shared;
  border_start(&d.border, d.tables->models + N_DETAIL_MODELS, s);

  int32_t stride = 2;
  if (j->parent.layer) {
    decode_border(&d.border);
    take_parents(&d);
  } else {
    stride = decode_root_corners(&d);
  }
  for (stride /= 2; stride >= 1 && !coder_is_cut(&d.coder); stride /= 2) {
    load_lattice(&d, stride);
    for (int which = HH; which <= LH; which++) {
      int down = which != HL, right = which != LH;
      if (!is_empty(&d, down, right)) TRY(decode_plane(&d, which, down, right, error));
    }
  }
  return coder_end(&d.coder, "a payload of method predictive", error);
}
