/* Method cdf97 (FORMAT §7). */
#include "border.h"
#include "steps.h"
#include "tables.h"

enum {
  N_RESIDUAL_MODELS = 1527,
  N_COEFFICIENT_MODELS = 4124,
  N_MODELS = N_RESIDUAL_MODELS + N_COEFFICIENT_MODELS + N_BORDER_MODELS,
  COEFFICIENTS = 1, RESIDUALS = 2, RAW = 4, /* flags */
  N_SETS = 16, N_TERMS = 19,
  MOST_TRANSFORMS = 12,
  EDGE = 2 /* samples around the core */
};
enum { HL, LH, HH, N_BANDS };
static const int64_t MOST = (int64_t)1 << 30;

typedef struct cdf97_tables {
  model models[N_MODELS]; /* of residuals, coefficients, the border */
  eighths eighths;
} cdf97_tables;

twz_status cdf97_tables_new(twz_file *f, twz_error *error) {
  cdf97_tables *t = f->cdf97 = twz_allocate(&f->allocator, sizeof *t);
  if (!t) return twz_no_memory(error, sizeof *t);
  TRY(read_starts(f, twz_cdf97_starts, twz_cdf97_starts_size, t->models, N_MODELS, error));
  fill_eighths(&t->eighths);
  return TWZ_OK;
}

/* ---- A unit ---- */

typedef struct decoding {
  const job *job;
  layer *out;
  coder coder;
  const eighths *eighths;
  model *residuals, *coefficients;
  border border;
  int32_t n;
  step_scale scale;
  size_t pitch;
  int32_t n_rows, n_cols; /* of the core */
  int32_t *predicted;     /* H, of the region; NULL in a root: 0 */
  int64_t *rows;          /* parent rows, extended and synthesised across */
  /* Coefficients, then details of the core: interleaved, values of transform t at multiples of 2^t. */
  int64_t *details;
  uint8_t *magnitudes[2][N_BANDS], *labels[2]; /* of the nodes of a transform, and of the one above */
  int64_t *base, *errors;                      /* of the core with EDGE around: beta and e of §7.7 */
  int32_t *mu;
  int8_t *signs;
  int64_t step_code;
  int offset, is_along[2];
  int is_finer; /* §7.9: a coarse unit of a faithful file */
} decoding;

/* ---- Low-pass synthesis (§7.2) ---- */

/* Fill two samples at both ends of x[0] ... x[n - 1], of distance s. */
static void extend(int64_t *x, ptrdiff_t s, int32_t n) {
  if (n == 1) {
    x[-2 * s] = x[-s] = x[s] = x[2 * s] = x[0];
    return;
  }
  int64_t *last = x + (n - 1) * s;
  x[-s] = 2 * x[0] - x[s];
  last[s] = 2 * last[0] - last[-s];
  x[-2 * s] = 2 * x[0] - x[2 * s];
  last[2 * s] = 2 * last[0] - last[-2 * s];
}

/* The sample at position q / 2, times 2^14. */
static ALWAYS_INLINE int64_t synthesised(const int64_t *x, ptrdiff_t s, int32_t q) {
  const int64_t *at = x + (q >> 1) * s;
  if (q & 1) return 9687 * (at[0] + at[s]) - 1495 * (at[-s] + at[2 * s]);
  return 18270 * at[0] - 943 * (at[-s] + at[s]);
}

static void predict_region(decoding *d) {
  const parent *p = &d->job->parent;
  const axis *rows = &d->out->rows, *cols = &d->out->cols;
  int32_t row_offset = (int32_t)(rows->first - 2 * p->first_row), col_offset = (int32_t)(cols->first - 2 * p->first_col);
  ptrdiff_t pitch = cols->n;
  int64_t *first = d->rows + 2 * pitch; /* the rows above and below are extensions */
  for (int32_t r = 0; r < p->n_rows; r++) {
    int64_t *x = d->border.sums;
    for (int32_t c = 0; c < p->n_cols; c++) x[c] = parent_height(p, r, c);
    extend(x, 1, p->n_cols);
    for (int i = 0; i < 4; i++) {
      int64_t *end = i < 2 ? x - 1 - i : x + p->n_cols + i - 2;
      *end = clamp_i64(*end, -2 * MOST, 2 * MOST);
    }
    for (int32_t c = 0; c < cols->n; c++) first[r * pitch + c] = synthesised(x, 1, c + col_offset);
  }
  for (int32_t c = 0; c < cols->n; c++) extend(first + c, pitch, p->n_rows);
  for (int32_t r = 0; r < rows->n; r++) {
    for (int32_t c = 0; c < cols->n; c++) {
      int64_t value = synthesised(first + c, pitch, r + row_offset);
      d->predicted[r * pitch + c] = (int32_t)clamp_i64(shift_right(value + (1 << 27), 28), -MOST, MOST);
    }
  }
}

/* ---- Border (§7.3) ---- */

static void predict_line(int64_t *sums, int32_t length, int64_t *predicted) {
  extend(sums, 1, (length + 1) >> 1);
  for (int32_t i = 0; i < length; i++) predicted[i] = shift_right(synthesised(sums, 1, i) + (1 << 14), 15);
}

/* ---- Raw heights (§7.4) ---- */

static void decode_raw(decoding *d, int n_bits, int64_t base) {
  int64_t most = ((int64_t)1 << 31) / d->n + 1;
  for (int32_t r = 0; r < d->n_rows && !coder_is_cut(&d->coder); r++) {
    for (int32_t c = 0; c < d->n_cols; c++) {
      size_t at = core_at(d->out, r, c);
      if (d->border.known[at]) continue;
      if (is_valid_at(d->out, at)) {
        int64_t i = min_i64((int64_t)raw_bits(&d->coder, n_bits), most);
        d->out->heights[at] = (int32_t)min_i64(base + i * d->n, MOST);
      } else {
        d->out->heights[at] = d->predicted ? d->predicted[at] : 0;
      }
    }
  }
}

/* ---- Coefficients (§7.5) ---- */

static const int16_t GAINS[3][MOST_TRANSFORMS] = {{3153, 2275, 1687, 1269, 958, 725, 548, 415, 314, 238, 180, 136},
                                                  {4050, 3104, 2242, 1663, 1251, 945, 715, 541, 409, 310, 234, 177},
                                                  {5203, 4235, 2981, 2181, 1634, 1233, 933, 706, 534, 404, 305, 230}};

/* Delta: s n 64 G / 2^17, whose numerator may need 86 bits; kind 0 LL, 1 HL and LH, 2 HH. */
static int64_t delta_of(const decoding *d, int t, int kind) {
  uint64_t product = (uint64_t)d->step_code * (uint64_t)d->n, factor = 64u * (uint64_t)GAINS[kind][t];
  uint64_t high = (product >> 32) * factor, low = (product & 0xFFFFFFFFu) * factor;
  if (high >= (uint64_t)1 << 26) return (int64_t)1 << 40;
  return clamp_i64((int64_t)((high << 15) + (low >> 17)), 1, (int64_t)1 << 40);
}

static int64_t dequantised(int64_t q, int64_t delta, int offset) {
  int64_t size = min_i64(abs_i64(q), ((int64_t)1 << 40) / delta + 1);
  int64_t value = ((size * 64 - offset) * delta) >> 6;
  return q < 0 ? -value : value;
}

/* Nodes of a transform, with two rows above and below and two columns on both sides that are 0. */
typedef struct nodes {
  int32_t n_rows, n_cols;
  ptrdiff_t pitch;
  uint8_t *magnitudes[N_BANDS], *labels;
} nodes;

static ptrdiff_t node_at(const nodes *g, int32_t i, int32_t j) { return (i + EDGE) * g->pitch + j + EDGE; }

static void take_nodes(const decoding *d, nodes *g, int which, int32_t n_rows, int32_t n_cols) {
  g->n_rows = n_rows;
  g->n_cols = n_cols;
  g->pitch = n_cols + 2 * EDGE;
  size_t n = (size_t)((n_rows + 2 * EDGE) * g->pitch);
  for (int band = 0; band < N_BANDS; band++) {
    g->magnitudes[band] = d->magnitudes[which][band];
    memset(g->magnitudes[band], 0, n);
  }
  g->labels = d->labels[which];
  memset(g->labels, 0, n);
}

static int64_t coefficient(decoding *d, int t, int band, int32_t s, int is_not_0) {
  int b = bin_of(min_i32(s >> 1, 4095));
  model *m = d->coefficients;
  if (!is_not_0 && !adaptive_bit(&d->coder, m + 540 + (3 * min_i32(t, 3) + band) * 36 + b)) return 0;
  int64_t size = 1 + magnitude(&d->coder, m + 972 + ((3 * min_i32(t, 1) + band) * 36 + b) * 14, m + 3996 + 32 * band,
                               max_i32(0, b / 3 - 6));
  return raw_bits(&d->coder, 1) ? -size : size;
}

static int32_t roughness(const decoding *d, int32_t i, int32_t j) {
  const parent *p = &d->job->parent;
  if (!p->layer) return 0;
  int32_t row = (int32_t)(d->out->rows.core_first / 2 - p->first_row) + i;
  int32_t col = (int32_t)(d->out->cols.core_first / 2 - p->first_col) + j;
  int32_t last_row = p->n_rows - 1, last_col = p->n_cols - 1;
  row = min_i32(row, last_row);
  col = min_i32(col, last_col);
  int64_t twice = 2 * (int64_t)parent_height(p, row, col);
  int64_t down = (int64_t)parent_height(p, max_i32(row - 1, 0), col) + parent_height(p, min_i32(row + 1, last_row), col);
  int64_t across = (int64_t)parent_height(p, row, max_i32(col - 1, 0)) + parent_height(p, row, min_i32(col + 1, last_col));
  return (int32_t)min_i64(4 * (abs_i64(down - twice) + abs_i64(across - twice)) / d->n, 1024);
}

/* S of a band: magnitudes at and around the node above and before it on its own grid. */
static int32_t significance(const decoding *d, const nodes *g, const nodes *above, int t, int band, int32_t i, int32_t j) {
  static const uint8_t WEIGHTS[4][6] = {/* W N NW NE WW NN */
                                        {6, 6, 0, 2, 1, 1}, {6, 5, 1, 2, 1, 1}, {1, 13, 0, 0, 0, 2}, {13, 1, 0, 0, 2, 0}};
  int32_t s = 0;
  if (above) {
    const uint8_t *p = above->magnitudes[band] + node_at(above, i >> 1, j >> 1);
    s = (2 * p[0] + p[-above->pitch] + p[above->pitch] + p[-1] + p[1]) >> 2;
  }
  const uint8_t *m = g->magnitudes[band] + node_at(g, i, j);
  int is_along = t == 0 && band != HH && d->is_along[band];
  const uint8_t *w = WEIGHTS[is_along ? 2 + band : band == HH];
  ptrdiff_t up = g->pitch;
  return s + w[0] * m[-1] + w[1] * m[-up] + w[2] * m[-up - 1] + w[3] * m[1 - up] + w[4] * m[-2] + w[5] * m[-2 * up];
}

static void decode_node(decoding *d, const nodes *g, const nodes *above, int t, int32_t i, int32_t j, const int *exists,
                        const int64_t *deltas) {
  ptrdiff_t at = node_at(g, i, j);
  if (above && !above->labels[node_at(above, i >> 1, j >> 1)]) return;
  int32_t s[N_BANDS];
  for (int band = 0; band < N_BANDS; band++) s[band] = significance(d, g, above, t, band, i, j);
  if (t == 0) {
    int32_t rough = roughness(d, i, j);
    s[HL] += rough;
    s[LH] += rough;
    s[HH] += rough >> 1;
  }
  int lambda = g->labels[at - 1] + g->labels[at - g->pitch];
  int label = (3 * min_i32(t, 4) + lambda) * 36 + bin_of(min_i32((s[HL] + s[LH] + s[HH]) >> 1, 4095));
  g->labels[at] = (uint8_t)adaptive_bit(&d->coder, d->coefficients + label);
  if (!g->labels[at]) return;
  int32_t before = 0; /* magnitudes of the node's bands */
  for (int band = 0; band < N_BANDS; band++) {
    if (!exists[band]) continue;
    int64_t q = coefficient(d, t, band, s[band] + before, t == 0 && band == HH && before == 0);
    int32_t size = (int32_t)min_i64(abs_i64(q), 255);
    g->magnitudes[band][at] = (uint8_t)size;
    before += size;
    if (q == 0) continue;
    ptrdiff_t row = 2 * i + (band != HL), col = 2 * j + (band != LH);
    d->details[((row * d->n_cols) + col) << t] = dequantised(q, deltas[band], d->offset);
  }
}

static int32_t size_at(int32_t n, int t) { return ((n - 1) >> t) + 1; }

static int n_transforms(const decoding *d) {
  int t = 1;
  while (size_at(d->n_rows, t) > 1 || size_at(d->n_cols, t) > 1) t++;
  return t;
}

static void decode_coefficients(decoding *d) {
  int n = n_transforms(d), e = 0;
  while (e < 31 && adaptive_bit(&d->coder, d->coefficients + 4092 + e)) e++;
  int64_t value = (((int64_t)1 << e) | (int64_t)raw_bits(&d->coder, e)) - 1;
  if (value && raw_bits(&d->coder, 1)) value = -value;
  d->details[0] = value ? dequantised(value, delta_of(d, n - 1, 0), 0) : 0;
  nodes grids[2];
  for (int t = n - 1; t >= 0; t--) {
    nodes *g = &grids[t & 1];
    const nodes *above = t == n - 1 ? NULL : &grids[(t + 1) & 1];
    int32_t n_rows = size_at(d->n_rows, t), n_cols = size_at(d->n_cols, t);
    take_nodes(d, g, t & 1, size_at(d->n_rows, t + 1), size_at(d->n_cols, t + 1));
    const int64_t deltas[N_BANDS] = {delta_of(d, t, 1), delta_of(d, t, 1), delta_of(d, t, 2)};
    for (int32_t i = 0; i < g->n_rows && !coder_is_cut(&d->coder); i++) {
      for (int32_t j = 0; j < g->n_cols; j++) {
        int has_col = j < n_cols >> 1, has_row = i < n_rows >> 1;
        const int exists[N_BANDS] = {has_col, has_row, has_row && has_col};
        decode_node(d, g, above, t, i, j, exists, deltas);
      }
    }
  }
}

/* ---- Inverse transform (§7.6) ---- */

/* Products of damaged streams may wrap; what comes out is clamped. */
static ALWAYS_INLINE int64_t lifted(int64_t x, int64_t weight, int64_t left, int64_t right) {
  uint64_t product = (uint64_t)weight * ((uint64_t)left + (uint64_t)right) + 2048;
  return (int64_t)((uint64_t)x - (uint64_t)((int64_t)product >> 12));
}

/* n lines of `length` values of distance s, `next` apart: one step, of even values (0) or odd ones (1). */
static void lift(int64_t *x, ptrdiff_t s, int32_t length, ptrdiff_t next, int32_t n, int is_odd, int64_t weight) {
  for (int32_t i = is_odd; i < length; i += 2) {
    int64_t *at = x + i * s;
    const int64_t *left = i > 0 ? at - s : at + s, *right = i + 1 < length ? at + s : at - s;
    for (int32_t k = 0; k < n; k++) at[k * next] = lifted(at[k * next], weight, left[k * next], right[k * next]);
  }
}

static void invert_lines(int64_t *x, ptrdiff_t s, int32_t length, ptrdiff_t next, int32_t n) {
  if (length < 2) return;
  lift(x, s, length, next, n, 0, 1817);
  lift(x, s, length, next, n, 1, 3616);
  lift(x, s, length, next, n, 0, -217);
  lift(x, s, length, next, n, 1, -6497);
}

static void invert_transforms(decoding *d) {
  for (int t = n_transforms(d) - 1; t >= 0; t--) {
    ptrdiff_t down = (ptrdiff_t)d->n_cols << t, right = (ptrdiff_t)1 << t;
    int32_t n_rows = size_at(d->n_rows, t), n_cols = size_at(d->n_cols, t);
    invert_lines(d->details, down, n_rows, right, n_cols);
    invert_lines(d->details, right, n_cols, down, n_rows);
  }
}

static ptrdiff_t edged_at(const decoding *d, int32_t r, int32_t c) {
  return (r + EDGE) * (ptrdiff_t)(d->n_cols + 2 * EDGE) + c + EDGE;
}

static void fill_base(decoding *d, int has_details) {
  for (int32_t r = 0; r < d->n_rows; r++) {
    size_t place = core_at(d->out, r, 0);
    for (int32_t c = 0; c < d->n_cols; c++, place++) {
      int64_t h = d->predicted ? d->predicted[place] : 0;
      int64_t x = has_details ? clamp_i64(d->details[(ptrdiff_t)r * d->n_cols + c], -256 * MOST, 256 * MOST) : 0;
      d->base[edged_at(d, r, c)] = clamp_i64(64 * h + x, -64 * MOST, 64 * MOST);
    }
  }
}

/* ---- Residuals (§7.7) ---- */

/* The base outside of x[0] ... x[n - 1], of distance s. */
static void extend_base(int64_t *x, ptrdiff_t s, int32_t n) {
  int64_t *last = x + (n - 1) * s;
  for (int32_t k = 1; k <= EDGE; k++) {
    x[-k * s] = 2 * x[0] - x[min_i32(k, n - 1) * s];
    last[k * s] = 2 * last[0] - x[max_i32(n - 1 - k, 0) * s];
  }
}

static ALWAYS_INLINE int64_t cut(int64_t x) { return clamp_i64(x, -((int64_t)1 << 30), (int64_t)1 << 30); }

static ALWAYS_INLINE int64_t around(const int64_t *b, ptrdiff_t up, int i, int j) {
  return cut(b[i * up + j] + b[i * up - j] + b[-i * up + j] + b[-i * up - j] - 4 * b[0]);
}

static int64_t predict_sample(const decoding *d, const int16_t *w, ptrdiff_t at) {
  ptrdiff_t up = d->n_cols + 2 * EDGE;
  const int64_t *b = d->base + at, *e = d->errors + at;
  const int64_t terms[N_TERMS] = {
      cut(b[1] + b[-1] - 2 * b[0]), cut(b[up] + b[-up] - 2 * b[0]), around(b, up, 1, 1),
      cut(b[2] + b[-2] - 2 * b[0]), cut(b[2 * up] + b[-2 * up] - 2 * b[0]), around(b, up, 1, 2), around(b, up, 2, 1),
      e[-1], e[-2], e[-up], e[-up - 1], e[1 - up], e[-up - 2], e[2 - up], e[-2 * up], e[-2 * up - 1], e[1 - 2 * up],
      e[-2 * up - 2], e[2 - 2 * up]};
  int64_t sum = 256 * b[0];
  for (int k = 0; k < N_TERMS; k++) sum += w[k] * terms[k];
  return clamp_i64(shift_right(sum, 8), -64 * MOST, 64 * MOST);
}

static int64_t expected_of(const decoding *d, ptrdiff_t at) {
  ptrdiff_t up = d->n_cols + 2 * EDGE;
  const int16_t *w = twz_cdf97_weights;
  const int32_t *m = d->mu + at;
  const int64_t *e = d->errors + at;
  int64_t slope = abs_i64(e[-up] - e[-up - 1]) + abs_i64(e[1 - up] - e[-up]);
  int64_t sum = (int64_t)w[0] * m[-1] + (int64_t)w[1] * m[-2] + (int64_t)w[2] * m[-up] + (int64_t)w[3] * m[-up - 1] +
                (int64_t)w[4] * m[1 - up] + (int64_t)w[5] * m[-2 * up] + w[7] + steps(&d->scale, w[6] * slope, -1);
  return min_i64(sum >> 4, ((int64_t)1 << 28) - 1);
}

/* The height of a coded sample; notes its sign. */
static int64_t decode_residual(decoding *d, ptrdiff_t at, int phase, int64_t h, int64_t phi) {
  ptrdiff_t up = d->n_cols + 2 * EDGE;
  int8_t *s = d->signs + at;
  int eta = min_i32(max_i32(((lg(d->eighths, expected_of(d, at)) - 24) >> 2) + 1, 0), 43);
  int flag = 4 * (44 * phase + eta) + (int)min_i64(steps(&d->scale, abs_i64(phi), -3), 3);
  if (!adaptive_bit(&d->coder, d->residuals + flag)) return h;
  int across = 2 * s[-1] + s[-up - 1], x = across < 0 ? 0 : across == 0 ? 1 : 2;
  int y = min_i32(max_i32(2 * s[-up] + s[1 - up], -2), 2) + 2;
  int slope = (int)min_i64((steps(&d->scale, 6 * abs_i64(phi), -5) + 1) >> 1, 3);
  int is_negative = adaptive_bit(&d->coder, d->residuals + 704 + 7 * (5 * x + y) + (phi > 0 ? 3 + slope : 3 - slope));
  s[0] = is_negative ? -1 : 1;
  int64_t quantum = d->n, more = 0;
  if (d->is_finer) {
    eta = min_i32(eta + 2, 43);
    quantum = (d->n - 1) / 2;
    more = quantum / 2;
  }
  int kappa = max_i32(0, ((20 + 4 * eta) >> 3) - 9);
  int64_t value = 1 + magnitude(&d->coder, d->residuals + 879 + 14 * eta, d->residuals + 1495, kappa);
  int64_t distance = min_i64(value, ((int64_t)1 << 31) / quantum + 1) * quantum + more;
  return clamp_i64(is_negative ? h - distance : h + distance, -MOST, MOST);
}

static void decode_residuals(decoding *d, int set) {
  ptrdiff_t up = d->n_cols + 2 * EDGE;
  for (int32_t r = 0; r < d->n_rows; r++) extend_base(d->base + edged_at(d, r, 0), 1, d->n_cols);
  for (int32_t c = -EDGE; c < d->n_cols + EDGE; c++) extend_base(d->base + edged_at(d, 0, c), up, d->n_rows);
  size_t n = (size_t)((d->n_rows + 2 * EDGE) * up);
  memset(d->errors, 0, n * sizeof *d->errors);
  memset(d->mu, 0, n * sizeof *d->mu);
  memset(d->signs, 0, n);
  for (int32_t r = 0; r < d->n_rows && !coder_is_cut(&d->coder); r++) {
    ptrdiff_t at = edged_at(d, r, 0);
    size_t place = core_at(d->out, r, 0);
    for (int32_t c = 0; c < d->n_cols; c++, at++, place++) {
      int phase = 2 * (r & 1) + (c & 1), known = d->border.known[place], valid = is_valid_at(d->out, place);
      int64_t p = predict_sample(d, twz_cdf97_terms[set][phase], at), h = shift_right(p + 32, 6), height = h;
      if (known) {
        height = d->out->heights[place];
      } else if (valid) {
        height = decode_residual(d, at, phase, h, p - 64 * h);
      }
      d->out->heights[place] = (int32_t)height;
      d->errors[at] = cut(64 * height - d->base[at]);
      if (known || valid) d->mu[at] = (int32_t)min_i64(steps(&d->scale, abs_i64(64 * height - p), -1), 32767);
    }
  }
}

/* ---- Payload (§7.1) ---- */

typedef struct fields {
  int flags, n_bits, set;
  int64_t base;
} fields;

static twz_status read_fields(decoding *d, reader *r, fields *f, twz_error *error) {
  TRY(read_byte(r, &f->flags, error));
  REQUIRE(f->flags <= RAW, error, "flags %d of method cdf97", f->flags);
  if (f->flags == RAW) {
    TRY(read_byte(r, &f->n_bits, error));
    REQUIRE(f->n_bits <= 32, error, "%d bits of a raw height, more than 32", f->n_bits);
    TRY(read_signed_varint(r, &f->base, error));
    REQUIRE(abs_i64(f->base) <= MOST, error, "a base of raw heights beyond 2^30");
  }
  if (f->flags & COEFFICIENTS) {
    uint64_t s;
    int byte;
    TRY(read_varint(r, &s, error));
    REQUIRE(s >= 1 && s <= (uint64_t)1 << 32, error, "step code %llu, not 1 to 2^32", (unsigned long long)s);
    d->step_code = (int64_t)s;
    TRY(read_byte(r, &byte, error));
    REQUIRE(byte < 64, error, "%d as the byte of offset and direction, 64 or more", byte);
    d->offset = byte & 15;
    d->is_along[HL] = byte >> 4 & 1;
    d->is_along[LH] = byte >> 5 & 1;
  }
  if (f->flags & RESIDUALS) {
    TRY(read_byte(r, &f->set, error));
    REQUIRE(f->set < N_SETS, error, "set %d of weights does not exist", f->set);
  }
  return TWZ_OK;
}

static twz_status take_memory(decoding *d, scratch *s, twz_error *error) {
  const parent *p = &d->job->parent;
  size_t n_region = (size_t)d->out->rows.n * d->pitch, n_core = (size_t)d->n_rows * (size_t)d->n_cols;
  size_t n_edged = (size_t)(d->n_rows + 2 * EDGE) * (size_t)(d->n_cols + 2 * EDGE);
  size_t n_nodes = (size_t)(d->n_rows / 2 + 1 + 2 * EDGE) * (size_t)(d->n_cols / 2 + 1 + 2 * EDGE);
  size_t n_rows = p->layer ? (size_t)(p->n_rows + 2 * EDGE) * d->pitch : 0;
  size_t n_models = N_RESIDUAL_MODELS + N_COEFFICIENT_MODELS;
  size_t n_bytes = n_region * 4 + n_rows * 8 + n_core * 8 + n_edged * 21 + n_nodes * 8 + n_models * sizeof(model);
  TRY(scratch_reserve(s, n_bytes + 16 * SCRATCH_ALIGN + border_bytes(d->job), error));
  d->predicted = p->layer ? scratch_take(s, n_region * 4) : NULL;
  d->rows = scratch_take(s, n_rows * 8);
  d->details = scratch_take(s, n_core * 8);
  d->base = scratch_take(s, n_edged * 8);
  d->errors = scratch_take(s, n_edged * 8);
  d->mu = scratch_take(s, n_edged * 4);
  d->signs = scratch_take(s, n_edged);
  for (int i = 0; i < 2; i++) {
    for (int band = 0; band < N_BANDS; band++) d->magnitudes[i][band] = scratch_take(s, n_nodes);
    d->labels[i] = scratch_take(s, n_nodes);
  }
  const model *starts = d->job->file->cdf97->models;
  d->residuals = scratch_take(s, n_models * sizeof(model));
  d->coefficients = d->residuals + N_RESIDUAL_MODELS;
  memcpy(d->residuals, starts, n_models * sizeof(model));
  border_start(&d->border, starts + n_models, s);
  memset(d->details, 0, n_core * 8);
  return TWZ_OK;
}

twz_status decode_cdf97(const job *j, const reader *bytes, scratch *s, twz_error *error) {
  static const char NAME[] = "a payload of method cdf97";
  const twz_file *f = j->file;
  decoding d;
  memset(&d, 0, sizeof d);
  fields given = {0, 0, 0, 0};
  reader r = *bytes;
  TRY(read_fields(&d, &r, &given, error));
  d.job = j;
  d.out = j->out;
  d.n = f->header.step;
  d.scale = step_scale_of(d.n);
  d.pitch = (size_t)d.out->cols.n;
  d.n_rows = d.out->rows.n_core;
  d.n_cols = d.out->cols.n_core;
  d.eighths = &f->cdf97->eighths;
  d.is_finer = (f->header.features & FAITHFUL) && j->level < f->grid.k_max && d.n > 1;
  const border shared = {.job = j, .coder = &d.coder, .step = d.n, .are_inherited_coded = 1, .predict = predict_line};
  d.border = shared;
  TRY(take_memory(&d, s, error));
  coder_start(&d.coder, r.bytes + r.at, r.n - r.at, f->rates);
  if (j->parent.layer) {
    predict_region(&d);
    decode_border(&d.border);
  }
  if (given.flags == RAW) {
    decode_raw(&d, given.n_bits, given.base);
    return coder_end(&d.coder, NAME, error);
  }
  if (given.flags & COEFFICIENTS) {
    decode_coefficients(&d);
    if (coder_is_cut(&d.coder)) return coder_end(&d.coder, NAME, error);
    invert_transforms(&d);
  }
  fill_base(&d, given.flags & COEFFICIENTS);
  if (given.flags & RESIDUALS) {
    decode_residuals(&d, given.set);
  } else {
    for (int32_t row = 0; row < d.n_rows; row++) {
      for (int32_t col = 0; col < d.n_cols; col++) {
        size_t at = core_at(d.out, row, col);
        if (!d.border.known[at]) d.out->heights[at] = (int32_t)shift_right(d.base[edged_at(&d, row, col)] + 32, 6);
      }
    }
  }
  return coder_end(&d.coder, NAME, error);
}
